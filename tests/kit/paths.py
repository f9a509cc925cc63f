"""Where things are in the checkout."""

from __future__ import annotations

from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
GOLDEN = ROOT / "tests" / "golden"
#: Larger golden cases and simulator assets, beside the checkout where there are any.
SHARED = ROOT.parent / "shared"
