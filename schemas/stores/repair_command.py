"""`verify --repair` of both command lines: what is done, and what is printed."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from vla_attention.schemas.safe_text import print_line, visible

if TYPE_CHECKING:
    from vla_attention.schemas.stores.repair import Finding

#: Of `vla-attention capture status`.
VERIFY_HELP = "read every byte, instead of only seals, presence and sizes of files"


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
        total = len(open_store(path).episodes) + sum(finding.moved_to is not None for finding in findings)
        print("\n".join(map(visible, _lines(path, findings, total, verify, dry_run))), flush=True)
        for line in (*mended, *_leftovers(path, dry_run)):
            print_line(line)
        if dry_run:
            print("Nothing was changed (--dry-run).", flush=True)
        left += sum(finding.moved_to is None for finding in findings)
    return 1 if left else 0


def _leftovers(path: Path, dry_run: bool) -> list[str]:
    """Remove what killed processes left; returns a line for each folder, also for those that stay."""
    from vla_attention.schemas.stores.partial_folders import dead_partials, partials_of_others, remove_dead_partials

    path = path.resolve() if path.is_symlink() else path
    dead, others = dead_partials(path), partials_of_others(path)
    no_folders = {one for one in dead if one.is_symlink() or not one.is_dir()}  # no process of ours left these
    if not dry_run:
        remove_dead_partials(path)
    would = "would be removed" if dry_run else "removed"
    lines = []
    for folder in dead:
        if folder in no_folders or (not dry_run and folder.exists()):
            lines.append(f"  left: {visible(str(folder))}, which is no folder or cannot be removed; delete it yourself")
        else:
            lines.append(f"  {would}: {visible(str(folder))}, left by a process that has ended")
    return lines + [
        f"  left: {visible(str(folder))}, written by another machine or container; delete it when no capture runs there"
        for folder in others
    ]


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
            lines.append(f"    left in the store, because it is claimed: {finding.holder.describe()}")
    if not dry_run and any(finding.moved_to is not None for finding in findings):
        lines.append("Run the same capture with --resume to record what was moved aside again.")
    return lines
