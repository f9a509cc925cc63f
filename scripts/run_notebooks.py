"""Run the notebooks of `examples/` from beginning to end, and store what they show in them.

Usage: python scripts/run_notebooks.py [NOTEBOOK ...]

A stored notebook is the same on every machine that computes the same numbers: it has no times, no counters and no path
of this machine, and its pictures are small. Exit code 1: a cell failed, and its notebook stays as it was. Needs
nbclient and ipykernel, and the package; `make notebooks` makes an environment for it.
"""

from __future__ import annotations

import argparse
import base64
import os
import re
import sys
import tempfile
import time
from io import BytesIO
from pathlib import Path

import nbformat
from nbclient import NotebookClient
from nbclient.exceptions import CellExecutionError
from PIL import Image

ROOT = Path(__file__).resolve().parents[1]
#: Seconds that one cell may take.
LONGEST_CELL = 120
#: Of a stored picture: most pixels from left to right.
WIDEST = 720
_IN_HTML = re.compile(r"(data:image/(?:png|webp);base64,)([\w+/=]+)")


def main() -> int:
    """Run the notebooks; returns the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("notebooks", nargs="*", type=Path, help="default: all of examples/")
    notebooks = parser.parse_args().notebooks or sorted((ROOT / "examples").glob("*.ipynb"))
    # Every notebook measures by itself, in ~/.cache; and the kernel finds the environment that runs this script.
    os.environ |= {"VLA_CACHE": "off", "PATH": f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"}
    os.environ.pop("XDG_CACHE_HOME", None)
    return max(run(path) for path in notebooks)


def run(path: Path) -> int:
    """Run one notebook in an empty folder and store it with what it shows; returns 0, or 1 after a cell that failed."""
    notebook = nbformat.read(path, as_version=4)
    begin = time.monotonic()
    with tempfile.TemporaryDirectory() as folder:
        client = NotebookClient(
            notebook,
            timeout=LONGEST_CELL,
            kernel_name="python3",
            record_timing=False,
            resources={"metadata": {"path": folder}},
        )
        try:
            client.execute()
        except CellExecutionError as error:
            print(f"{path.name}: FAILED\n{error}", file=sys.stderr)
            return 1
    notebook.metadata.language_info = {"name": "python"}
    cells = [cell for cell in notebook.cells if cell.cell_type == "code"]
    for cell in cells:
        cell.execution_count = None
        for output in cell.outputs:
            tidy(output)
    nbformat.write(notebook, path)
    kilobytes = path.stat().st_size / 1000
    print(f"{path.name}: {len(cells)} cells, {kilobytes:.0f} kB, {time.monotonic() - begin:.1f} s", flush=True)
    return 0


def tidy(output: nbformat.NotebookNode) -> None:
    """Take out of an output what would differ elsewhere, and make its pictures small."""
    if "execution_count" in output:
        output.execution_count = None
    for holder, kind in [(output, "text"), *((output.get("data", {}), kind) for kind in ("text/plain", "text/html"))]:
        if kind in holder:
            text = holder[kind].replace(str(Path.home()), "~")
            holder[kind] = _IN_HTML.sub(lambda match: match[1] + smaller(match[2]), text)
    if "image/png" in output.get("data", {}):
        output.data["image/png"] = smaller(output.data["image/png"])
        output.data.pop("text/plain")  # the size of the figure


def smaller(encoded: str) -> str:
    """A picture in base64, in the same format, not wider than WIDEST."""
    picture = Image.open(BytesIO(base64.b64decode(encoded)))
    kind, image = picture.format, picture.convert("RGB")
    if image.width > WIDEST:
        image = image.resize((WIDEST, round(image.height * WIDEST / image.width)), Image.Resampling.LANCZOS)
    file = BytesIO()
    if kind == "PNG":
        image.quantize(method=Image.Quantize.FASTOCTREE, dither=Image.Dither.NONE).save(file, kind, optimize=True)
    else:
        image.save(file, kind, quality=60)
    return base64.b64encode(file.getvalue()).decode()


if __name__ == "__main__":
    sys.exit(main())
