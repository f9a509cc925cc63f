"""`vla-analyze merge`: one store of the episodes of several stores of one run."""

from __future__ import annotations

import argparse
from pathlib import Path

from vla_attention.analyze.arguments import add_workers
from vla_attention.schemas.command_line import command_parser, format_bytes
from vla_attention.schemas.stores.store_url import store_place

_EXAMPLES = """examples:
  vla-analyze merge node1/libero_10.zarr node2/libero_10.zarr -o libero_10.zarr
  vla-analyze merge a.zarr b.zarr c.zarr -o all.zarr --copy           own files, where a.zarr is on another disk anyway
  vla-analyze merge packed.zarr hf://datasets/ORG/NAME/more.zarr -o all.zarr
  vla-analyze merge a.zarr b.zarr -o all.zarr --packed                one file an episode

The stores have to be of one run configuration: what differs is named. No two of them may hold the same episode. The
merged store shares the files of the given ones (hard links), so that it takes no space; a damage of one is then a
damage of both, and --copy makes files of its own. What comes from a zip or from elsewhere is always copied. The merged
store has a folder for each episode; with --packed it has a zip for each and an index, as `copy --packed` writes them.
Everything is read back before the store appears under its name.
"""


def build_parser() -> argparse.ArgumentParser:
    """The parser of `vla-analyze merge A B -o C`."""
    parser = command_parser(
        "vla-analyze merge", "Make one store of the episodes of several stores of one run configuration.", _EXAMPLES
    )
    parser.add_argument("stores", nargs="+", type=store_place, metavar="STORE", help="NAME.zarr or addresses")
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="DEST", help="the merged store, NAME.zarr")
    parser.add_argument("--copy", action="store_true", help="copy every file, instead of hard links")
    parser.add_argument("--packed", action="store_true", help="one zip file an episode and an index of them")
    add_workers(parser)
    return parser


def run(arguments: argparse.Namespace) -> int:
    """Merge the stores."""
    from vla_attention.analyze.merge.merging import merge_stores
    from vla_attention.analyze.show.numbers import plural
    from vla_attention.schemas.progress_bar import progress_bar
    from vla_attention.schemas.stores.reader import open_store

    stores = [open_store(path) for path in arguments.stores]
    with progress_bar(sum(len(store.episodes) for store in stores), "episodes") as advance:
        merged = merge_stores(stores, arguments.output, advance, link=not arguments.copy, packed=arguments.packed)
    parts = ", ".join(f"{len(store.episodes)} of {store.path}" for store in stores)
    shared = f"; {format_bytes(merged.linked_bytes)} are shared with the given stores" if merged.linked_bytes else ""
    print(f"{arguments.output}: {plural(merged.episodes, 'episode')} ({parts}), all whole{shared}.")
    return 0
