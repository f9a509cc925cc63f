"""`vla-analyze verify`: read everything back and check it."""

from __future__ import annotations

import argparse

from vla_attention.analyze.arguments import add_workers
from vla_attention.analyze.show.numbers import plural
from vla_attention.schemas.command_line import command_parser
from vla_attention.schemas.stores.store_url import store_place


def build_parser() -> argparse.ArgumentParser:
    """The parser of `vla-analyze verify STORE ...`."""
    parser = command_parser(
        "vla-analyze verify",
        "Read everything back and check counts, missing chunks, digests and row sums. Exit code 1 if anything is "
        "wrong.",
    )
    parser.add_argument("stores", nargs="+", type=store_place, metavar="STORE", help="NAME.zarr or addresses")
    add_workers(parser)
    return parser


def run(arguments: argparse.Namespace) -> int:
    """Verify every store; 1 if anything is wrong."""
    from vla_attention.analyze.show.progress import progress_bar
    from vla_attention.analyze.stores.checking import faults_of_each
    from vla_attention.schemas.stores.reader import open_store

    faulty = False
    for path in arguments.stores:
        store = open_store(path)
        with progress_bar(len(store.episodes), "episodes") as advance:
            pairs = ((store, episode) for episode in store.episodes)
            faults = [fault for found in faults_of_each(pairs, advance) for fault in found]
        for fault in faults:
            print(f"{path}: {fault.episode}: {fault.problem}")
        result = plural(len(faults), "fault") if faults else "all whole"
        print(f"{path}: {plural(len(store.episodes), 'episode')}, {result}.")
        faulty = faulty or bool(faults)
    return 1 if faulty else 0
