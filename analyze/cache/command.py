"""`vla-attention cache`: what is kept of earlier analyses, and removing it."""

from __future__ import annotations

import argparse

from vla_attention.schemas.command_line import command_parser

_EXAMPLES = """examples:
  vla-attention cache
  vla-attention cache --clear
  VLA_CACHE=/scratch/me/cache VLA_CACHE_SIZE=10GB vla-attention analyze runs/libero_10.zarr
  VLA_CACHE=off vla-attention analyze runs/libero_10.zarr
"""


def build_parser() -> argparse.ArgumentParser:
    """The parser of `vla-attention cache`."""
    parser = command_parser(
        "vla-attention cache",
        "Shows what is kept of earlier analyses: masses of episodes, so that another plot or one more episode costs "
        "only what is new. It is in results/.cache unless VLA_CACHE names another folder; VLA_CACHE=off, or "
        "--no-cache with a command, measures everything anew. VLA_CACHE_SIZE is the most it takes (default: 2GB): what "
        "was not used for longest goes first. Without it every number is the same.",
        _EXAMPLES,
    )
    parser.add_argument("--clear", action="store_true", help="remove everything in it; nothing is lost but time")
    return parser


def run(arguments: argparse.Namespace) -> int:
    """Print the cache's contents, or remove them."""
    from vla_attention.analyze.cache.housekeeping import clear, describe_cache, kept_files
    from vla_attention.analyze.cache.places import FOLDER_VARIABLE, cache_place
    from vla_attention.analyze.show.numbers import format_bytes
    from vla_attention.schemas.errors import BadArgument

    place = cache_place()
    if place is None:
        print(f"The cache is off: {FOLDER_VARIABLE} says so. Unset it, or name a folder by it.")
        return 0
    if not arguments.clear:
        print(describe_cache(place, kept_files(place.folder)))
        return 0
    removed = clear(place.folder)
    if left := kept_files(place.folder):
        raise BadArgument(
            f"{len(left)} files in {place.folder} cannot be removed, for instance {left[0].path}: they belong to "
            "somebody else. Ask them, or name another folder by VLA_CACHE."
        )
    print(f"Removed {format_bytes(removed)} from {place.folder}.")
    return 0
