"""`vla-analyze copy`: a copy of a store: smaller, packed, from elsewhere, or uploaded."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from vla_attention.analyze.show.numbers import format_percent, plural
from vla_attention.schemas.command_line import command_parser, format_bytes
from vla_attention.schemas.errors import BadArgument
from vla_attention.schemas.stores.store_url import store_place

if TYPE_CHECKING:
    from vla_attention.schemas.stores.reader import Store

_EXAMPLES = """examples:
  vla-analyze copy libero_10.zarr                               how large each part is
  vla-analyze copy libero_10.zarr slim.zarr --without frames
  vla-analyze copy libero_10.zarr slim.zarr --without frames objects contributions effects
  vla-analyze copy libero_10.zarr slim.zarr --without frames    again: adds what was captured meanwhile
  vla-analyze copy libero_10.zarr packed.zarr --packed          one file an episode
  vla-analyze copy libero_10.zarr packed.zarr --packed --push hf://datasets/ORG/NAME/libero_10.zarr
  vla-analyze copy hf://datasets/ORG/NAME/libero_10.zarr here.zarr

frames: the cameras' pictures (overlays and reruns need them). objects: what each patch shows (object: groups need it).
contributions: norms of what keys add. effects: changes of the action without an item. Rows, and everything else that
groupings of keys, words, cameras and roles need, are always copied. The copy passes verify, and its provenance names
the omitted parts.
"""


def build_parser() -> argparse.ArgumentParser:
    """The parser of `vla-analyze copy STORE DEST`."""
    parser = command_parser(
        "vla-analyze copy",
        "Copy a store, for instance without its pictures or packed into few files; without DEST, print how large each\n"
        "part is.",
        _EXAMPLES,
    )
    parser.add_argument("store", type=store_place, metavar="STORE", help="NAME.zarr, or its address")
    parser.add_argument("target", type=Path, nargs="?", metavar="DEST", help="where the copy goes, NAME.zarr")
    parser.add_argument(
        "--without",
        nargs="+",
        default=[],
        metavar="PART",
        help="frames, objects, contributions, effects (default: copy all)",
    )
    parser.add_argument(
        "--packed",
        action="store_true",
        help="one zip file an episode and an index of them; every command reads it in place, here and elsewhere",
    )
    parser.add_argument(
        "--push",
        metavar="hf://datasets/ORG/NAME/FILE.zarr",
        help="upload the packed copy to the Hugging Face hub, with a card that says what it holds",
    )
    return parser


def run(arguments: argparse.Namespace) -> int:
    """Copy the store, or print how large its parts are."""
    from vla_attention.analyze.copy.copying import check_parts, copy_store
    from vla_attention.schemas.progress_bar import progress_bar
    from vla_attention.schemas.stores.reader import open_store

    store = open_store(arguments.store)
    without = check_parts(arguments.without)
    if arguments.target is None:
        if arguments.packed or arguments.push:
            raise BadArgument("--packed and --push need a DEST: the packed copy is made here first; give DEST.zarr.")
        print(_sizes_text(store, without))
        return 0
    if arguments.push and not arguments.packed:
        raise BadArgument("--push uploads a packed copy: a hub takes few files only; add --packed.")
    push = None
    if arguments.push:
        from vla_attention.analyze.copy.pushing import check_push

        push = check_push(arguments.push)
    with progress_bar(len(store.episodes), "episodes") as advance:
        copied = copy_store(store, arguments.target, without, advance, packed=arguments.packed)
    already = f" ({copied.present} were there already)" if copied.present else ""
    left = f", {format_bytes(copied.left_bytes)} left behind: {', '.join(without)}" if without else ""
    added = plural(copied.added, "episode")
    print(f"{arguments.target}: {added} added{already}, {format_bytes(copied.copied_bytes)}{left}.")
    if push is not None:
        from vla_attention.analyze.copy.pushing import push_store

        print(push_store(arguments.target, push))
    return 0


def _sizes_text(store: Store, without: Sequence[str]) -> str:
    """The size of each part of the store, and of a copy without some of them."""
    from vla_attention.analyze.copy.copying import PARTS, REST, part_sizes

    sizes = part_sizes(store)
    total = sum(sizes.values())
    lines = [f"{store.path}: {plural(len(store.episodes), 'episode')}, {format_bytes(total)}"]
    for name, size in sizes.items():
        purpose = "rows, atoms, roles, actions: always copied" if name == REST else PARTS[name].purpose
        share = format_percent(size / total if total else 0.0, 0)
        mark = "  left behind" if name in without else ""
        lines.append(f"  {name:<13} {format_bytes(size):>8}  {share:>4}  {purpose}{mark}")
    if without:
        rest = format_bytes(total - sum(sizes[name] for name in without))
        lines.append(f"A copy without {', '.join(without)} takes {rest}.")
    return "\n".join(lines)
