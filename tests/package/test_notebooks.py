"""The notebooks of examples/ as they are in the repository; `make notebooks` runs them and stores what they show."""

from __future__ import annotations

import ast
import json
import re

import pytest

from tests.kit.paths import ROOT
from vla_attention.example_stores import archive_of

NOTEBOOKS = sorted((ROOT / "examples").glob("*.ipynb"))


def cells(path, kind):
    """The sources of a notebook's cells of one kind."""
    notebook = json.loads(path.read_text(encoding="utf-8"))
    return ["".join(cell["source"]) for cell in notebook["cells"] if cell["cell_type"] == kind]


def python_of(source):
    """A cell without the lines that only IPython reads."""
    lines = []
    for line in source.split("\n"):
        shell = line.lstrip().startswith(("%", "!")) or " = !" in line
        lines.append(line[: len(line) - len(line.lstrip())] + "pass" if shell else line)
    return "\n".join(lines)


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_what_it_shows_is_stored_and_the_same_on_every_machine(path):
    text = path.read_text(encoding="utf-8")
    assert len(text) < 400_000
    assert not re.search(r"[\s\"'>](?:/(?:home|root|tmp|Users|work)/|[A-Z]:\\)", text.replace("\\n", "\n"))
    code = [cell for cell in json.loads(text)["cells"] if cell["cell_type"] == "code"]
    assert all(cell["execution_count"] is None for cell in code)
    outputs = [output for cell in code for output in cell["outputs"]]
    assert outputs
    assert all(output["output_type"] != "error" and output.get("name") != "stderr" for output in outputs)


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_what_it_imports_exists(path):
    for source in cells(path, "code"):
        for node in ast.walk(ast.parse(python_of(source))):
            if isinstance(node, ast.Call) and ast.unparse(node.func) == "va.example":
                assert archive_of(ast.literal_eval(node.args[0])).is_file()
