"""`vla-attention store copy`, `verify` and `outcomes`: keeping stores."""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from vla_attention.analyze.options import add_workers
from vla_attention.schemas.command_line import OneSentenceParser, format_bytes
from vla_attention.schemas.errors import BadArgument, plural
from vla_attention.schemas.stores.store_url import local_path, store_place
from vla_attention.schemas.stores.verify_command import DESCRIPTION, EXAMPLES, add_verify_arguments, run_verify_command
from vla_attention.schemas.threads import add_threads

if TYPE_CHECKING:
    from vla_attention.schemas.stores.reader import Store
    from vla_attention.schemas.stores.store_url import StorePlace
    from vla_attention.schemas.stores.verify import Depth, EpisodeReport

_DESCRIPTION = """Copy a store, for instance without its pictures or as a tar file an episode, or make one store of
several of one run. Without a place to copy to, print how large each part is."""
_EXAMPLES = """examples:
  vla-attention store copy libero_10.zarr                               how large each part is
  vla-attention store copy libero_10.zarr slim.zarr --without frames
  vla-attention store copy libero_10.zarr slim.zarr --without frames objects contributions effects
  vla-attention store copy libero_10.zarr slim.zarr --without frames    again: adds what was captured meanwhile
  vla-attention store copy libero_10.zarr tars.zarr --tar               one file an episode, to be carried
  vla-attention store copy tars.zarr libero_10.zarr                     and back
  vla-attention store copy hf://datasets/ORG/NAME/libero_10.zarr here.zarr
  vla-attention store copy node1/libero_10.zarr node2/libero_10.zarr --output libero_10.zarr     one store of several

frames: the cameras' pictures (overlays and reruns need them). objects: what each patch shows (object: groups need it).
contributions: norms of what tokens add. effects: changes of the action without an item. steps: positions and goals.
Rows, and everything else that groupings of tokens, words, cameras and roles need, are always copied. The copy passes
verify, and its provenance names the omitted parts.

Several stores have to be of one run configuration: what differs is named. No two of them may hold the same episode. The
one store shares the files of the given ones (hard links), so that it takes no space; a damage of one is then a damage
of both, and --copy makes files of its own. What comes from elsewhere is always copied.
"""


_OUTCOMES = """Tell the outcomes of episodes after they were recorded, from a scorer or a person. They lie beside the
sealed episodes in outcomes.json; every question uses them, and copies keep them."""
_OUTCOMES_EXAMPLES = """examples:
  vla-attention store outcomes run.zarr scores.csv
  vla-attention store outcomes run.zarr --remove

A row of FILE.csv for each episode whose outcome the recording left open:
  task_id,episode_index,success
  0,0,1
  0,1,0"""


def build_parser() -> argparse.ArgumentParser:
    """The parser of `vla-attention store`: copy, verify, outcomes."""
    parser = OneSentenceParser(
        prog="vla-attention store", description="Keep stores: copies, one store of several, checks."
    )
    acts = parser.add_subparsers(required=True, metavar="copy|verify|outcomes", parser_class=OneSentenceParser)
    what = "a copy: smaller, in tar files, from elsewhere; or one store of several"
    copy = acts.add_parser("copy", help=what, description=_DESCRIPTION, epilog=_EXAMPLES)
    given = "NAME.zarr or addresses; several become one store"
    copy.add_argument("stores", nargs="+", type=store_place, metavar="STORE", help=given)
    where = "where the copy goes, NAME.zarr; of two names without --output the second one is DEST"
    copy.add_argument("-o", "--output", type=Path, metavar="DEST", help=where)
    parts = "frames, objects, contributions, effects, steps (default: copy all)"
    copy.add_argument("--without", nargs="+", default=[], metavar="PART", help=parts)
    tars = "one tar file an episode, where many files are a burden; store copy makes a store of them again"
    copy.add_argument("--tar", action="store_true", help=tars)
    files = "of several stores: copy every file, instead of sharing it (hard links)"
    copy.add_argument("--copy", action="store_true", help=files)
    what = "compare every file with what was sealed; --repair moves damaged episodes aside"
    examples = EXAMPLES.replace("NAME", "vla-attention store")
    verify = acts.add_parser("verify", help=what, description=DESCRIPTION, epilog=examples)
    add_verify_arguments(verify)
    what = "tell outcomes of episodes that the recording did not know"
    outcomes = acts.add_parser("outcomes", help=what, description=_OUTCOMES, epilog=_OUTCOMES_EXAMPLES)
    outcomes.add_argument("store", type=Path, metavar="STORE")
    what = "CSV with the columns task_id, episode_index and success (1 or 0, true or false)"
    outcomes.add_argument("file", nargs="?", type=Path, metavar="FILE.csv", help=what)
    outcomes.add_argument("--remove", action="store_true", help="take back what was told so far")
    for act, answer in ((copy, _run_copy), (verify, _run_verify), (outcomes, _run_outcomes)):
        act.set_defaults(act=answer)
        if act is not outcomes:
            add_workers(act)
        add_threads(act, "threads that read episodes, at most 4 (default: OMP_NUM_THREADS, else the process's cores)")
    return parser


def run(arguments: argparse.Namespace) -> int:
    """Do what was asked; returns the exit code."""
    code: int = arguments.act(arguments)
    return code


def _run_verify(arguments: argparse.Namespace) -> int:
    """Verify every store; 1 if anything is wrong, or with --repair if a damaged episode is left."""
    from vla_attention.analyze.stores.parallel import episode_reports

    def reports(store: Store, depth: Depth) -> Iterator[EpisodeReport]:
        return episode_reports(((store, episode) for episode in store.episodes), depth)

    return run_verify_command(arguments, reports)


def _run_copy(arguments: argparse.Namespace) -> int:
    """Copy the store, make one of several, or print how large the parts are."""
    from vla_attention.analyze.store.copying import check_parts

    stores, target = list(arguments.stores), arguments.output
    if target is None and len(stores) == 2:
        target = local_path(stores.pop())
    if target is None and len(stores) > 2:
        raise BadArgument(f"{len(stores)} stores and no place for the one that they become; add --output DEST.zarr.")
    without = check_parts(arguments.without)
    if target is None:
        if arguments.tar:
            raise BadArgument("--tar needs a place for the copy; give DEST.zarr.")
        from vla_attention.schemas.stores.reader import open_store

        print(_sizes_text(open_store(stores[0]), without))
        return 0
    if len(stores) > 1:
        if without or arguments.tar:
            option = "--without" if without else "--tar"
            raise BadArgument(f"{option} is for one store; make one of the several first, then copy that.")
        return _merge(stores, target, copy=arguments.copy)
    if arguments.copy:
        raise BadArgument("--copy is for several stores: the copy of one has files of its own anyway.")
    return _copy(stores[0], target, without, tar=arguments.tar)


def _run_outcomes(arguments: argparse.Namespace) -> int:
    """Tell outcomes, or take them back."""
    from vla_attention.analyze.store.outcomes import remove_outcomes, tell_outcomes

    path = arguments.store
    if arguments.remove == (arguments.file is not None):
        raise BadArgument("Give either the CSV file of outcomes, or --remove to take back what was told.")
    if arguments.remove:
        remove_outcomes(path)
        print(f"{path}: outcomes that were told after the recording are taken back.")
        return 0
    told = tell_outcomes(path, arguments.file)
    known = f" ({told.known} were known to be so)" if told.known else ""
    unread = f" Not read: the columns {', '.join(told.unread)}." if told.unread else ""
    print(f"{path}: outcomes of {plural(told.added, 'episode')} are told{known}.{unread}")
    return 0


def _copy(place: StorePlace, target: Path, without: Sequence[str], *, tar: bool) -> int:
    from vla_attention.analyze.store.copying import copy_store, open_source
    from vla_attention.schemas.progress_bar import progress_bar

    store = open_source(place)
    with progress_bar(len(store.episodes), "episodes") as advance:
        copied = copy_store(store, target, without, advance, tar=tar)
    already = f" ({copied.present} were there already)" if copied.present else ""
    left = f", {format_bytes(copied.left_bytes)} left behind: {', '.join(without)}" if without else ""
    print(f"{target}: {plural(copied.added, 'episode')} added{already}, {format_bytes(copied.copied_bytes)}{left}.")
    return 0


def _merge(places: Sequence[StorePlace], target: Path, *, copy: bool) -> int:
    from vla_attention.analyze.store.merging import merge_stores
    from vla_attention.schemas.progress_bar import progress_bar
    from vla_attention.schemas.stores.reader import open_store

    stores = [open_store(path) for path in places]
    with progress_bar(sum(len(store.episodes) for store in stores), "episodes") as advance:
        merged = merge_stores(stores, target, advance, link=not copy)
    parts = ", ".join(f"{len(store.episodes)} of {store.path}" for store in stores)
    shared = f"; {format_bytes(merged.linked_bytes)} are shared with the given stores" if merged.linked_bytes else ""
    print(f"{target}: {plural(merged.episodes, 'episode')} ({parts}), all whole{shared}.")
    return 0


def _sizes_text(store: Store, without: Sequence[str]) -> str:
    """The size of each part of the store, and of a copy without some of them."""
    from vla_attention.analyze.store.copying import PARTS, REST, part_sizes

    sizes = part_sizes(store)
    total = sum(sizes.values())
    lines = [f"{store.path}: {plural(len(store.episodes), 'episode')}, {format_bytes(total)}"]
    for name, size in sizes.items():
        purpose = "rows, atoms, roles, actions: always copied" if name == REST else PARTS[name][0]
        share = f"{size / total if total else 0.0:.0%}"
        mark = "  left behind" if name in without else ""
        lines.append(f"  {name:<13} {format_bytes(size):>8}  {share:>4}  {purpose}{mark}")
    if without:
        rest = format_bytes(total - sum(sizes[name] for name in without))
        lines.append(f"A copy without {', '.join(without)} takes {rest}.")
    return "\n".join(lines)
