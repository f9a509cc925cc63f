"""The trained policies that come with this package, by their names: checkpoint folders inside of it."""

from __future__ import annotations

from pathlib import Path

#: A small pi0.5 for the suite `cubes`; `docs/cubes.md` says how it was trained and what it can do.
CUBES_POLICY = "pi05_cubes"
SHIPPED: dict[str, Path] = {CUBES_POLICY: Path(__file__).parent / CUBES_POLICY}
