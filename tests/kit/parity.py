"""Parity: what a policy computes here, against what a reference implementation computed on the same weights and inputs.

Usage: python -m tests.kit.parity CASE [--json] [--device cuda]

A case is a folder with case.json, inputs.npz, expected.npz and a checkpoint; docs/my-checkpoint.md says how.
Prints the largest differences. Exit code 1: one of them is beyond its limit.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np


def read_case_file(folder: Path) -> dict[str, Any]:
    """Return the content of a case's case.json."""
    content: dict[str, Any] = json.loads((folder / "case.json").read_text(encoding="utf-8"))
    return content


def read_arrays(path: Path) -> dict[str, np.ndarray]:
    """Return the arrays of an npz file by their names."""
    with np.load(path, allow_pickle=False) as stored:
        return dict(stored)


def json_number(x: float) -> float | None:
    """Return a number for JSON; None for NaN and infinity, which JSON does not have."""
    return float(x) if np.isfinite(x) else None


def main(given: Sequence[str] | None = None) -> int:
    """Run a case, of a pi model or of Cosmos Policy, and print the differences."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("case", type=Path, metavar="CASE", help="case folder")
    parser.add_argument("--json", action="store_true", help="print the result as JSON")
    parser.add_argument("--device", default="cpu", help="cpu (default), cuda, cuda:1 ...")
    arguments = parser.parse_args(given)
    if "kind" in read_case_file(arguments.case):  # of Cosmos, with the kind of the case
        from tests.kit.cosmos_parity import run_parity
    else:
        from tests.kit.pi_parity import run_parity
    results = list(run_parity(arguments.case, device=arguments.device))
    if arguments.json:
        print(json.dumps([result.as_json() for result, _ in results], indent=2))
    else:
        print("\n".join(text for _, text in results))
    return 0 if results and all(result.passed for result, _ in results) else 1


if __name__ == "__main__":
    sys.exit(main())
