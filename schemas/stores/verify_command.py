"""`verify` of both command lines: its arguments, a line for every episode, and JSON for programs; and `--repair`."""

from __future__ import annotations

import argparse
import json
import os
import sys
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vla_attention.schemas.command_line import format_bytes
from vla_attention.schemas.errors import BadArgument, Note, plural
from vla_attention.schemas.jsonable import to_json
from vla_attention.schemas.safe_text import print_line
from vla_attention.schemas.stores.store_url import StorePlace, local_path, store_place

if TYPE_CHECKING:
    from vla_attention.schemas.stores.reader import Store
    from vla_attention.schemas.stores.repair import Finding
    from vla_attention.schemas.stores.verify import Depth, EpisodeReport

DESCRIPTION = (
    "Compare every file with what was sealed, and what an episode says with its run. A line for every episode. Foreign "
    "files are named; nothing reads them. Exit code 1 if anything is wrong."
)
EXAMPLES = """examples:
  NAME verify libero_10.zarr                      every byte of every episode
  NAME verify libero_10.zarr --quick              seals, metadata, presence and sizes: milliseconds an episode
  NAME verify libero_10.zarr --values             the numbers too: row sums, roles, shares, as the writer checked them
  NAME verify *.zarr --json > report.json         for programs
  NAME verify libero_10.zarr --repair --dry-run   what would be moved aside
  NAME verify libero_10.zarr --repair --quick     move aside what a quick look finds
"""
#: Reports of the episodes of a store, in their order, looked at as deep as asked.
Reports = Callable[["Store", "Depth"], Iterable["EpisodeReport"]]


#: Of `vla-attention capture status`.
VERIFY_HELP = "read every byte, instead of only seals, presence and sizes of files"
_LOOKED: dict[Depth, str] = {
    "quick": "seals, metadata, presence and sizes; without --quick every byte is read",
    "files": "every file; --values looks at the numbers too",
    "values": "every file and number",
}
_OPTIONS = {
    "--quick": "look at seals, metadata, and the presence and size of every file, and read no array",
    "--values": "read the arrays, too, and apply the rules that the writer applied: row sums, roles, shares, counts",
    "--json": "print everything as JSON",
    "--repair": "move damaged episodes into NAME.zarr.damaged, beside the store, with the reason, and remove what "
    "killed processes of this machine left; no episode is deleted, and those that are being written are left alone",
    "--dry-run": "with --repair: list what would be done, and do none of it",
}


def add_verify_arguments(parser: argparse.ArgumentParser) -> None:
    """The arguments of `verify`."""
    parser.add_argument("stores", nargs="+", type=store_place, metavar="STORE", help="NAME.zarr or addresses")
    for option, text in _OPTIONS.items():
        parser.add_argument(option, action="store_true", help=text)


def one_after_the_other(store: Store, depth: Depth) -> Iterator[EpisodeReport]:
    """Reports of the episodes, made in this thread."""
    from vla_attention.schemas.stores.verify import episode_report

    return (episode_report(store, replace(episode), depth) for episode in store.episodes)  # what is read goes with it


def run_verify_command(arguments: argparse.Namespace, reports: Reports = one_after_the_other) -> int:
    """Check the stores of parsed arguments, or repair them; returns the exit code."""
    if arguments.repair:
        for option in ("json", "values"):
            if getattr(arguments, option):
                raise BadArgument(f"Cannot use --{option} with --repair; verify again with --{option}.")
        places = [local_path(place) for place in arguments.stores]
        return run_repair(places, verify=not arguments.quick, dry_run=arguments.dry_run)
    if arguments.dry_run:
        raise BadArgument("--dry-run goes with --repair: without it nothing is changed anyway.")
    if arguments.quick and arguments.values:
        raise BadArgument("--quick reads no array and --values reads all; give one of them.")
    depth: Depth = "quick" if arguments.quick else "values" if arguments.values else "files"
    found = [_verified(place, depth, reports, as_json=arguments.json) for place in arguments.stores]
    if arguments.json:
        print(json.dumps(found, indent=1))
    return int(not all(one["whole"] for one in found))


def _verified(path: StorePlace, depth: Depth, reports: Reports, *, as_json: bool) -> dict[str, Any]:
    """Check a store, and print a line for every episode unless all of it will be printed as JSON."""
    from vla_attention.schemas.progress_bar import progress_bar
    from vla_attention.schemas.stores.episode_files import foreign_in_store
    from vla_attention.schemas.stores.reader import open_store
    from vla_attention.schemas.stores.verify import store_faults

    def say(line: str) -> None:
        if not as_json:
            print_line(f"{path}: {line}")

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", Note)  # what lies among the episodes is named below
        store = open_store(path, as_recorded=True)
    faults, foreign = store_faults(store), foreign_in_store(store)
    found: list[EpisodeReport] = []
    for fault in faults:
        say(f"{fault.where}: {fault.problem}")
    # Lines at a terminal show how far it is, too.
    with progress_bar(len(store.episodes), "episodes", hidden=sys.stdout.isatty() and not as_json) as advance:
        for report in reports(store, depth):
            advance(1)
            found.append(report)
            whole = f"whole, {report.files} files, {format_bytes(report.bytes)}"
            for problem in report.problems or (whole,):
                say(f"{report.episode}: {problem}")
    for name in (*foreign, *(f"{report.episode}: {name}" for report in found for name in report.foreign)):
        say(f"{name} is no part of the store; nothing reads it")
    number = len(faults) + sum(len(report.problems) for report in found)
    say(f"{plural(len(found), 'episode')}, {plural(number, 'fault') if number else 'all whole'} ({_LOOKED[depth]}).")
    return {
        "store": str(store.path),
        "version": store.attributes.store_version,
        "depth": depth,
        "whole": not number,
        "faults": to_json(faults),
        "foreign": list(foreign),
        "episodes": to_json(found),
    }


def run_repair(stores: Sequence[Path], *, verify: bool, dry_run: bool) -> int:
    """Repair stores, and print what was found and done.

    Returns:
        The exit code: 1 if a damaged episode is left in a store, else 0.
    """
    from vla_attention.schemas.stores.reader import open_store
    from vla_attention.schemas.stores.repair import repair_groups, repair_store

    left = 0
    for path in stores:
        findings = repair_store(path, verify, dry_run)
        mended = repair_groups(path, dry_run)
        total = len(open_store(path, as_recorded=True).episodes) + sum(
            finding.moved_to is not None for finding in findings
        )
        for line in (*_lines(path, findings, total, verify, dry_run), *mended, *_leftovers(path, dry_run)):
            print_line(line)
        if dry_run:
            print("Nothing was changed (--dry-run).", flush=True)
        left += sum(finding.moved_to is None for finding in findings)
    return 1 if left else 0


def _leftovers(path: Path, dry_run: bool) -> list[str]:
    """Remove what ended processes left; returns a line for each file and folder, also for those that stay."""
    from vla_attention.schemas.stores.locks import episode_locks, store_locks

    path = path.resolve() if path.is_symlink() else path
    lines = []
    for locks in (episode_locks(path), store_locks(path)):
        found = locks.leftovers()
        if not dry_run:
            locks.sweep()
        for place, holder in found.items():
            if holder is not None:
                lines.append(f"  left: {place}, of {holder.describe()}")
            elif os.path.lexists(place) and not dry_run:
                lines.append(f"  left: {place}, which cannot be removed; delete it yourself")
            else:
                lines.append(f"  {'would be removed' if dry_run else 'removed'}: {place}, of a process that has ended")
    return lines


def _lines(path: Path, findings: Sequence[Finding], total: int, verify: bool, dry_run: bool) -> list[str]:
    if not findings:
        looked = "every byte was read" if verify else "seals, presence and sizes; without --quick every byte is read"
        return [f"{path}: none of {total} episodes is damaged ({looked})."]
    lines = [f"{path}: {len(findings)} of {total} episodes {'is' if len(findings) == 1 else 'are'} damaged."]
    for finding in findings:
        lines.append(f"  {finding.damaged.describe()}")
        if finding.moved_to is not None:
            lines.append(f"    moved to {finding.moved_to}")
        elif finding.holder is not None:
            lines.append(f"    left in the store, because it is being written: {finding.holder.describe()}")
    if not dry_run and any(finding.moved_to is not None for finding in findings):
        lines.append("Run the same capture with --resume to record what was moved aside again.")
    return lines
