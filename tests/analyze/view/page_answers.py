"""Ask the page's own script, run by node, what it shows of stores behind a web server."""

from __future__ import annotations

import json
import shutil
import subprocess
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import pytest

HERE = Path(__file__).resolve().parent
SCRIPT = HERE.parents[2] / "analyze/view/bundle/viewer.js"
NODE = shutil.which("node")
needs_node = pytest.mark.skipif(NODE is None, reason="the page's script is run by node, which is not installed")


@dataclass(frozen=True)
class PageQuestion:
    """An episode of a store whose root is at `base` + `root`, and a link's query; effects need its `summary`."""

    base: str
    root: str
    episode: str = "task000_episode000"
    query: str = ""
    summary: str = ""


def run_in_node(script: str, folder: Path, given: Any) -> str:
    """What a script of this folder writes, which gets the page's module, JSON, and where to write; files in between."""
    assert NODE is not None
    module = folder / "viewer.mjs"  # by its ending node takes it for a module
    module.write_bytes(SCRIPT.read_bytes())
    (folder / "given.json").write_text(json.dumps(given))
    done = subprocess.run(
        [NODE, HERE / script, module, folder / "given.json", folder / "found.json"],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return (folder / "found.json").read_text()


def page_answers(folder: Path, questions: Sequence[PageQuestion]) -> list[dict[str, Any]]:
    """What the page shows for each question (see `page_numbers.mjs`)."""
    answers: list[dict[str, Any]] = json.loads(
        run_in_node("page_numbers.mjs", folder, [asdict(question) for question in questions])
    )
    return answers
