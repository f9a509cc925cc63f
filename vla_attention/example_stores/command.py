"""`vla-attention example`: copies of the small stores that are shipped, and first questions to them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory

from vla_attention.example_stores import EXAMPLES, archive_of
from vla_attention.schemas.command_line import OneSentenceParser, run_command
from vla_attention.schemas.errors import BadArgument

PROGRAM = "vla-attention example"
_EXAMPLES = """examples:
  vla-attention example                copies into the folder example
  vla-attention example ~/attention    copies into another one
"""
_QUESTIONS = """\
{cubes}: 6 episodes of 'touch the red (green, blue) cube' by pi05_cubes, a small trained pi0.5. It listens, and it
  looks for the cube that is named
{cubes_one_colour}: the same by a copy of it to which the three colours are one word. It does not listen, and fails
{cubes_noise}: the first policy calls of {cubes} again, with other noise

Does it listen?           vla-attention language {cubes}
Looks or reads?           vla-attention analyze {cubes}
Where does it look?       vla-attention objects {cubes}
What moves the action?    vla-attention effects {cubes}
Why did it fail?          vla-attention failures {cubes_one_colour} --twins {cubes}
What changed?             vla-attention compare {cubes} {cubes_one_colour}
All of it in one file     vla-attention report {cubes}
A page to explore         vla-attention view {cubes}
"""


def main(argv: Sequence[str]) -> int:
    """Copy the stores; returns the exit code."""
    parser = OneSentenceParser(
        prog=PROGRAM, description="Copy the small stores that are shipped into a folder.", epilog=_EXAMPLES
    )
    parser.add_argument("folder", nargs="?", type=Path, default=Path("example"), metavar="FOLDER", help="where to")
    folder: Path = parser.parse_args(argv).folder
    return run_command(PROGRAM, lambda: _copy(folder), "nothing was left half written.")


def _copy(folder: Path) -> int:
    copies = {name: folder / f"{name}.zarr" for name in EXAMPLES}
    if there := [store for store in copies.values() if store.exists()]:
        raise BadArgument(f"{there[0]} exists; remove it, or name another folder: vla-attention example FOLDER.")
    from vla_attention.schemas.stores.store_place import refuse_in_store
    from vla_attention.schemas.stores.tar_files import unpack

    refuse_in_store(folder, "copy stores to")
    folder.mkdir(parents=True, exist_ok=True)
    # On a full disk there is no store, rather than half of one.
    with TemporaryDirectory(dir=folder, prefix=".copying-") as part:
        for name in copies:
            unpack(archive_of(name), Path(part))
        for store in copies.values():
            (Path(part) / store.name).rename(store)
    print(_QUESTIONS.format(**copies), end="")
    return 0
