"""What the viewer's page computes, run by node: the script that ships, which exports its arithmetic as `engine`."""

from __future__ import annotations

import json
import shutil
import subprocess
from pathlib import Path
from typing import Any

import pytest

from tests.analyze.view.grouping_cases import AXES
from tests.kit.paths import ROOT

HERE = Path(__file__).resolve().parent
SCRIPT = ROOT / "analyze/view/bundle/viewer.js"
NODE = shutil.which("node")
needs_node = pytest.mark.skipif(NODE is None, reason="the page's script is run by node, which is not installed")


def run_in_node(folder: Path, cases: dict[str, Any]) -> dict[str, list[Any]]:
    """What the page makes of lists of cases by their kind; the kinds are in `viewer_in_node.mjs`.

    Args:
        folder: an empty one, for files.
        cases: kind -> cases, and the `episodes` that those of the kind `cases` are about. JSON values.
    """
    assert NODE is not None
    module = folder / "viewer.mjs"  # by its ending node takes it for a module
    module.write_bytes(SCRIPT.read_bytes())
    (folder / "cases.json").write_text(json.dumps({**cases, "axes": AXES}, allow_nan=False), encoding="utf-8")
    done = subprocess.run(
        [NODE, HERE / "viewer_in_node.mjs", module, folder / "cases.json", folder / "results.json"],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    found: dict[str, list[Any]] = json.loads((folder / "results.json").read_text(encoding="utf-8"))
    return found
