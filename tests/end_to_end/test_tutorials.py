"""The tutorials of docs/: commands of blocks marked `bash`, blocks of Python and the TOML file, as they stand.

Only plots are left out, which the tests of each command draw.
"""

from __future__ import annotations

import json
import re
import shlex
from pathlib import Path

import pytest

from tests.kit.lerobot_data_sets import H264, made_up_episodes, write_data_set
from vla_attention.__main__ import main as every_command

DOCS = Path(__file__).parents[2] / "docs"
NOTEBOOKS = sorted((DOCS.parent / "examples").glob("*.ipynb"))
#: Questions that draw plots beside their text.
PLOTTED = ("analyze", "words", "objects", "effects", "compare")


def walk(page: str) -> int:
    """Run the blocks of a tutorial in their order, in the working directory; returns the number of commands."""
    return run_blocks((DOCS / page).read_text(encoding="utf-8"), page)


def run_blocks(text: str, page: str) -> int:
    """Run the blocks of a text in their order, in the working directory; returns the number of commands."""
    commands = 0
    for language, block in re.findall(r"^```(bash|python|toml)\n(.*?)^```", text, re.MULTILINE | re.DOTALL):
        if language == "toml":
            for name in re.findall(r'^name = "(.*)"$', block, re.MULTILINE):  # others are parts of a file
                Path(f"{name}.toml").write_text(block)
        elif language == "python":
            exec(compile(block, page, "exec"), {})
        else:
            for line in block.replace("\\\n", " ").splitlines():
                program, *arguments = shlex.split(line, comments=True)
                assert program == "vla-attention"
                if arguments[0] in PLOTTED and "--list" not in arguments:
                    arguments.append("--no-plots")
                assert every_command(arguments) == 0, line
                commands += 1
    return commands


@pytest.mark.thorough
@pytest.mark.simulator
def test_my_checkpoint(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert walk("my-checkpoint.md") == 6
    assert "touch the red cube" in capsys.readouterr().out
    assert Path("results/runs/mine/report/report.html").stat().st_size > 10_000


@pytest.mark.thorough
@pytest.mark.simulator
@pytest.mark.parametrize(
    "page",
    ["does-it-listen", "why-did-it-fail", "what-changed", "effects", "reading", "statistics", "groups", "commands"],
)
def test_questions_to_the_examples(tmp_path, monkeypatch, page):
    monkeypatch.chdir(tmp_path)
    assert walk(f"{page}.md") > 0


def test_a_store_is_read_without_our_code(tmp_path, monkeypatch, capsys):
    """The page of the format, on the example that it names."""
    monkeypatch.chdir(tmp_path)
    assert every_command(["example"]) == 0
    capsys.readouterr()
    assert walk("store.md") == 0
    printed = capsys.readouterr().out
    assert "touch the red cube - solved\nbase_0_rgb 0.102\nleft_wrist_0_rgb 0.233\n" in printed
    assert "True True True" in printed
    assert "False" not in printed


@pytest.mark.thorough
def test_my_data_set(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    cameras = ("observation.images.front", "observation.images.wrist")
    episodes = made_up_episodes((12, 9, 7), cameras=cameras)
    write_data_set(tmp_path / "data" / "so101_pick", "v3.0", episodes, video=H264)
    assert walk("my-data-set.md") == 8


@pytest.mark.thorough
@pytest.mark.parametrize("notebook", NOTEBOOKS, ids=lambda path: path.stem)
def test_commands_in_the_text_of_notebooks(tmp_path, monkeypatch, capsys, notebook):
    """`make notebooks` runs the cells of code; these commands stand in cells of text."""
    monkeypatch.chdir(tmp_path)
    cells = json.loads(notebook.read_text(encoding="utf-8"))["cells"]
    text = "\n\n".join("".join(cell["source"]) for cell in cells if cell["cell_type"] == "markdown")
    assert run_blocks(text, notebook.name) == (4 if notebook.stem == "interventions" else 0)
