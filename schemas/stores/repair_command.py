"""`verify --repair` of both command lines: what is done, and what is printed."""

from __future__ import annotations

import os
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
