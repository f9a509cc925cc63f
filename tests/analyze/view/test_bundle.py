"""The page as it ships: it is what its sources build, and it names no other place."""

from __future__ import annotations

import hashlib
import json
import os
import re
import shutil
import subprocess
from pathlib import Path

import pytest

VIEW = Path(__file__).resolve().parents[3] / "analyze/view"
BUNDLE, SOURCES = VIEW / "bundle", VIEW / "web"
NEXT_STEP = "Run `make viewer` and commit analyze/view/bundle."


def sha256(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()


def digest_of_sources(folder: Path) -> str:
    """The digest that `build.mjs` writes: of lines "sha256  path" of all files, node_modules left out."""
    files = (Path(at, name) for at, _, names in os.walk(folder) for name in names)
    paths = sorted(file.relative_to(folder).as_posix() for file in files)
    lines = [
        f"{sha256((folder / path).read_bytes())}  {path}\n" for path in paths if not path.startswith("node_modules/")
    ]
    return sha256("".join(lines).encode())


def test_the_bundle_is_the_build_of_the_sources():
    built = json.loads((BUNDLE / "build.json").read_text())
    assert built["sources"] == digest_of_sources(SOURCES), f"The page was built from other sources. {NEXT_STEP}"
    files = {path.name: sha256(path.read_bytes()) for path in BUNDLE.iterdir() if path.name != "build.json"}
    assert built["files"] == files, f"Files of the bundle are not those that were built. {NEXT_STEP}"


@pytest.mark.skipif(
    shutil.which("node") is None or not (SOURCES / "node_modules/esbuild").exists(),
    reason="no node, or its packages are not installed (make viewer)",
)
def test_a_new_build_gives_the_same_bytes(tmp_path):
    subprocess.run(["node", SOURCES / "build.mjs", tmp_path / "built"], check=True)
    new = {path.name: path.read_bytes() for path in (tmp_path / "built").iterdir()}
    assert new == {path.name: path.read_bytes() for path in BUNDLE.iterdir()}, NEXT_STEP


def test_the_page_loads_its_own_files_only():
    page = (BUNDLE / "index.html").read_text()
    loaded = re.findall(r'(?:src|href)="([^"]*)"', page)
    assert {"main.js", "main.css"} <= set(loaded) <= {path.name for path in BUNDLE.iterdir()} | {"data:,"}
    # The server forbids both (content security policy); a static site does not.
    assert not re.search(r"<script(?![^>]*\bsrc=)|\bon\w+=|\bstyle=", page)
    style = (BUNDLE / "main.css").read_text()
    assert not re.search(r"@import|url\((?![\"']?data:)", style)
