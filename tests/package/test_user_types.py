"""What a type checker knows of `va` in a user's file."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.thorough

pytest.importorskip("mypy", reason="a part of the extra dev")

ROOT = Path(__file__).parents[2]
#: Skipped modules are of type Any; this package's own are followed.
SETTINGS = """
[mypy]
strict = True
follow_imports = silent
[mypy-torch.*,numpy.*,zarr.*,polars.*,matplotlib.*,numcodecs.*,vla_attention.analyze.*]
follow_imports = skip
"""
USER = """
from typing import Any, assert_type

import vla_attention as va
from vla_attention.capture.torch_policies.inspect_calls import CallTable
from vla_attention.capture.torch_policies.layout_check import LayoutCheck
from vla_attention.capture.torch_policies.recorded_episodes import Episode, EpisodeBatch, Replan
from vla_attention.capture.torch_policies.session import RecordedRun

def collect(policy: object, state: list[float], pictures: dict[str, Any]) -> None:
    span = va.Span("image_front", "image", 0, 4, "front", va.PatchGrid(2, 2, 8, 8))
    site = va.RecordedSite(va.SiteLayout("joint", (span,)), (0, 3), {"image_front": "image"})
    rule = va.CallRule(r"blocks\\.(?P<block>\\d+)", "joint")
    layout = va.PolicyLayout(name="a", family="a", sites=(site,), rules=(rule,), num_layers=2, num_heads=2)
    assert_type(va.layouts.smolvla(policy), va.PolicyLayout)
    assert_type(va.inspect(policy, lambda: None), CallTable)
    assert_type(va.check_layout(policy, lambda: None, layout, {"span:image_front": lambda: None}), LayoutCheck)
    assert_type(va.__version__, str)
    run = va.record("run.zarr", policy, layout=layout)
    assert_type(run, RecordedRun)
    with run, run.episode(task_id=0, episode_index=0, instruction="") as episode:
        assert_type(episode, Episode)
        with episode.replan(env_step=0, state=state, frames=pictures, noise_seed=3) as replan:
            assert_type(replan, Replan)
    with run.episodes([{"task_id": 0}]) as batch, batch.replan(env_step=[0], state=[state]):
        assert_type(batch, EpisodeBatch)
        assert_type(batch[0], Episode)
        assert_type(batch[:1], list[Episode])
    assert_type(va.datasets.open("data"), va.datasets.LeRobotDataset)
"""
#: Line of a user -> what the type checker says of it.
MISTAKES = {
    "va.recrod('run.zarr', policy, layout=layout)": r'Module has no attribute "recrod"',
    "va.record('run.zarr', policy, layout=layout, quieries='all')": r'Unexpected keyword argument "quieries"',
    "va.record('run.zarr', policy, layout=3)": r'"layout" to "record" has incompatible type "int"',
    "va.layouts.smolvlla(policy)": r'Module has no attribute "smolvlla"',
    "va.PolicyLayout(nam='a')": r'Unexpected keyword argument "nam"',
    "va.Span('a', 'picture', 0, 4)": r'expected "?(Literal|SpanKind)',
    "episode.replan(env_step=0, frame={})": r'"frame" to "replan" of "Episode" has incompatible type',
    "episode.replan(env_step=0, frames=3)": r'"frames" to "replan" of "Episode" has incompatible type "int"',
    "batch.replan(env_step=0, stat=[])": r'"stat" to "replan" of "EpisodeBatch" has incompatible type',
}


def test_a_user_s_file(tmp_path):
    wrong = [
        "import vla_attention as va",
        "from vla_attention.capture.torch_policies.recorded_episodes import Episode, EpisodeBatch",
        "def use(policy: object, layout: va.PolicyLayout, episode: Episode, batch: EpisodeBatch) -> None:",
        *(f"    {line}" for line in MISTAKES),
    ]
    (tmp_path / "right.py").write_text(USER)
    (tmp_path / "wrong.py").write_text("\n".join(wrong))
    (tmp_path / "mypy.ini").write_text(SETTINGS)
    command = [sys.executable, "-m", "mypy", "--no-error-summary", "--hide-error-context", "--no-pretty"]
    run = subprocess.run(
        [*command, "right.py", "wrong.py"],
        cwd=tmp_path,
        env={**os.environ, "MYPYPATH": str(ROOT)},
        capture_output=True,
        text=True,
        check=False,
    )
    found: dict[tuple[str, int], str] = {}
    for line in run.stdout.splitlines():
        match = re.match(r"(right|wrong)\.py:(\d+): error: (.*)", line)
        assert match is not None or ": note:" in line, line
        if match is not None:
            found.setdefault((match[1], int(match[2])), match[3])
    assert not run.stderr
    for number, (line, sentence) in enumerate(MISTAKES.items(), start=4):
        assert re.search(sentence, found.pop(("wrong", number), "nothing")), (line, run.stdout)
    assert not found
