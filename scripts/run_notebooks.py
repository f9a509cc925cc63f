"""Run the notebooks of `examples/` from beginning to end, as a hosted notebook would.

Usage: python scripts/run_notebooks.py [--folder results/notebooks] [NOTEBOOK ...]

In the repository they have no outputs: those would change with every run and get out of date. The executed notebooks,
their pictures (NAME_CELL.png) and their texts (NAME.txt) are put into the folder, to be looked at. Exit code 1: a cell
failed. Needs nbclient and ipykernel, and the package; `make notebooks` makes an environment for it.
"""

from __future__ import annotations

import argparse
import base64
import os
import sys
import time
from pathlib import Path

import nbformat
from nbclient import NotebookClient
from nbclient.exceptions import CellExecutionError

ROOT = Path(__file__).resolve().parents[1]
#: Seconds that one cell may take.
LONGEST_CELL = 120


def main() -> int:
    """Run the notebooks; returns the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("notebooks", nargs="*", type=Path, help="default: all of examples/")
    parser.add_argument(
        "--folder", type=Path, default=Path("results/notebooks"), help="where the executed ones are put"
    )
    given = parser.parse_args()
    folder = given.folder.resolve()
    notebooks = [path.resolve() for path in given.notebooks] or sorted((ROOT / "examples").glob("*.ipynb"))
    folder.mkdir(parents=True, exist_ok=True)
    # Every notebook measures by itself, and the kernel finds the environment that runs this script.
    os.environ |= {"VLA_CACHE": "off", "PATH": f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"}
    return max(run(path, folder) for path in notebooks)


def run(path: Path, folder: Path) -> int:
    """Run one notebook in the folder and keep what it shows; returns 0, or 1 after a cell that failed."""
    notebook = nbformat.read(path, as_version=4)
    client = NotebookClient(
        notebook, timeout=LONGEST_CELL, kernel_name="python3", resources={"metadata": {"path": str(folder)}}
    )
    begin = time.monotonic()
    try:
        client.execute()
        failed = ""
    except CellExecutionError as error:
        failed = str(error)
    nbformat.write(notebook, folder / path.name)
    pictures = keep_outputs(notebook, folder / path.stem)
    cells = sum(cell.cell_type == "code" for cell in notebook.cells)
    took = f"{time.monotonic() - begin:.1f} s"
    print(f"{path.name}: {cells} cells, {pictures} pictures, {took}{': FAILED' if failed else ''}", flush=True)
    if failed:
        print(failed, file=sys.stderr)
    return int(bool(failed))


def keep_outputs(notebook: nbformat.NotebookNode, stem: Path) -> int:
    """Write the texts that cells printed or returned, and their pictures; returns the number of pictures."""
    texts, pictures = [], 0
    for number, cell in enumerate(notebook.cells):
        for output in cell.get("outputs", ()):
            data = output.get("data", {})
            if "image/png" in data:
                stem.with_name(f"{stem.name}_{number}.png").write_bytes(base64.b64decode(data["image/png"]))
                pictures += 1
            else:
                texts.append(f"[{number}] " + (output.get("text") or data.get("text/plain") or ""))
    stem.with_suffix(".txt").write_text("\n".join(texts) + "\n", encoding="utf-8")
    return pictures


if __name__ == "__main__":
    sys.exit(main())
