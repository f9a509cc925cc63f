"""`vla-analyze copy`: a smaller copy of a store."""

from __future__ import annotations

import argparse
from pathlib import Path

from vla_attention.schemas.command_line import command_parser

_EXAMPLES = """examples:
  vla-analyze copy libero_10.zarr                               how large each part is
  vla-analyze copy libero_10.zarr slim.zarr --without frames
  vla-analyze copy libero_10.zarr slim.zarr --without frames objects contributions
  vla-analyze copy libero_10.zarr slim.zarr --without frames    again: adds what was captured meanwhile

frames: the cameras' pictures (overlays need them). objects: what each patch shows (object: groups need it).
contributions: norms of what keys add. Rows, and everything else that groupings of keys, words, cameras and
roles need, are always copied. The copy passes verify, and its provenance names the omitted parts.
"""


def build_parser() -> argparse.ArgumentParser:
    """The parser of `vla-analyze copy STORE DEST`."""
    parser = command_parser(
        "vla-analyze copy",
        "Copy a store, for instance without its pictures; without DEST, print how large each part is.",
        _EXAMPLES,
    )
    parser.add_argument("store", type=Path, metavar="STORE", help="NAME.zarr")
    parser.add_argument("target", type=Path, nargs="?", metavar="DEST", help="where the copy goes, NAME.zarr")
    parser.add_argument(
        "--without", nargs="+", default=[], metavar="PART", help="frames, objects, contributions (default: copy all)"
    )
    return parser


def run(arguments: argparse.Namespace) -> int:
    """Copy the store, or print how large its parts are."""
    from vla_attention.analyze.copy.copying import PARTS, REST, check_parts, copy_store, part_sizes
    from vla_attention.analyze.show.progress import progress_bar
    from vla_attention.schemas.stores.reader import open_store

    store = open_store(arguments.store)
    without = check_parts(arguments.without)
    if arguments.target is None:
        sizes = part_sizes(store)
        total = sum(sizes.values())
        print(f"{store.path}: {len(store.episodes)} episodes, {_size(total)}")
        for name, size in sizes.items():
            purpose = "rows, atoms, roles, actions: always copied" if name == REST else PARTS[name].purpose
            share = size / total if total else 0.0
            mark = "  left behind" if name in without else ""
            print(f"  {name:<13} {_size(size):>8}  {share:>4.0%}  {purpose}{mark}")
        if without:
            print(f"A copy without {', '.join(without)} takes {_size(total - sum(sizes[name] for name in without))}.")
        return 0
    with progress_bar(len(store.episodes), "episodes") as advance:
        copied = copy_store(store, arguments.target, without, advance)
    there = f" ({copied.present} were there already)" if copied.present else ""
    left = f", {_size(copied.left_bytes)} left behind: {', '.join(without)}" if without else ""
    print(f"{arguments.target}: {copied.added} episodes added{there}, {_size(copied.copied_bytes)}{left}.")
    return 0


def _size(count: float) -> str:
    """A byte count for people, decimal units."""
    for unit in ("B", "kB", "MB", "GB"):
        if count < 999.5:
            return f"{count:.3g} {unit}"
        count /= 1000
    return f"{count:.3g} TB"
