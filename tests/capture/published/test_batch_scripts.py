"""The batch scripts without SLURM: the meaning of their variables, and one sentence without leftovers for a mistake."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

import vla_attention
from vla_attention.capture.__main__ import main as capture
from vla_attention.capture.policies.cosmos.family import FAMILY as COSMOS
from vla_attention.capture.policies.family import PolicyFamily
from vla_attention.capture.policies.pi.family import FAMILY as PI
from vla_attention.capture.published.evaluate import arguments_from_environment, evaluate
from vla_attention.schemas.errors import BadArgument

SCRIPTS = Path(__file__).resolve().parents[3] / "scripts"


def run(script: str, folder: Path, *words: str, **variables: str) -> subprocess.CompletedProcess[str]:
    """Run a script in an empty folder with these environment variables only."""
    environment = {"PATH": f"{Path(sys.executable).parent}:/usr/bin:/bin", "HOME": str(folder), **variables}
    return subprocess.run(
        ["bash", SCRIPTS / script, *words],
        env=environment,
        cwd=folder,
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )


@pytest.mark.parametrize(
    ("script", "variables", "named"),
    [
        ("run_attention_ratio.sh", {"LAYERS": "25 late"}, "LAYERS .*'25 late'"),
        ("run_attention_ratio_cosmos.sh", {"TASK_SUITE": "libero_spacial"}, "'libero_spatial'"),
        (
            "run_attention_ratio.sh",
            {"SLURM_JOB_ID": "1", "SLURM_ARRAY_TASK_ID": "10"},
            " 10 .*libero_10, .* 10; .*--array=0-9",
        ),
    ],
)
def test_a_mistake_is_one_sentence_and_leaves_nothing(tmp_path, script, variables, named):
    (tmp_path / "file").write_text("")
    done = run(script, tmp_path, CHECKPOINT="untrained-tiny", **variables)
    assert done.returncode == 2, done.stderr
    assert re.search(named, done.stderr)
    assert done.stderr.count("\n") == 1
    assert [entry.name for entry in tmp_path.iterdir()] == ["file"]


def test_an_installation_without_a_clone_has_the_scripts(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    for _ in range(2):
        assert capture(["slurm"]) == 0
    written = {path.name: path.read_bytes() for path in (tmp_path / "scripts").iterdir()}
    assert written == {path.name: path.read_bytes() for path in SCRIPTS.glob("*_attention_ratio*.sh")}
    assert all(os.access(tmp_path / "scripts" / name, os.X_OK) for name in written)
    capsys.readouterr()
    (tmp_path / "scripts/run_attention_ratio.sh").write_text("mine")
    assert capture(["slurm"]) == 2
    assert "scripts/run_attention_ratio.sh: there already" in capsys.readouterr().err
    assert (tmp_path / "scripts/run_attention_ratio.sh").read_text() == "mine"


def test_the_helper_prints_what_it_would_submit(tmp_path):
    done = run("submit_attention_ratio.sh", tmp_path, "--dry-run", "cosmos", "--gpus=1", TASK_SUITE="all")
    assert done.returncode == 0, done.stderr
    array, analysis = done.stdout.splitlines()
    assert "STAGE=capture sbatch --parsable --array=0-39 --gpus=1" in array
    assert "STAGE=analyze sbatch" in analysis
    assert "--dependency=afterok:JOB" in analysis
    assert "--gpus" not in analysis
    assert all(line.strip().endswith("run_attention_ratio_cosmos.sh") for line in (array, analysis))


def arguments(family: PolicyFamily = PI, **variables: str) -> list[str]:
    return arguments_from_environment(variables, family)


def test_variables_become_the_options_that_they_name():
    assert arguments() == []
    assert arguments(TASK_SUITE="", LAYERS=" ", SAVE_VIZ="0", TASK_ID="") == []
    assert arguments(LAYERS="0 8 25", SAVE_VIZ="1", ARGS="--max-steps 10") == [
        *("--layers", "0", "8", "25"),
        "--save-viz",
        *("--max-steps", "10"),
    ]
    assert arguments(TASK_ID="0 3", PROTOCOL="lerobot") == ["--task-id", "0", "3", "--protocol", "lerobot"]
    assert arguments(CKPT_PATH="a b") == ["--checkpoint", "a b"]
    assert arguments(COSMOS, TEXT_FRAME="frame0") == ["--text-frame", "frame0"]


def test_a_job_with_a_real_checkpoint_needs_a_gpu():
    assert arguments(SLURM_JOB_ID="1") == ["--device", "cuda"]
    assert arguments(SLURM_JOB_ID="1", CHECKPOINT="untrained-tiny") == ["--checkpoint", "untrained-tiny"]
    assert arguments(SLURM_JOB_ID="1", DEVICE="cpu") == ["--device", "cpu"]
    assert arguments(SLURM_JOB_ID="1", STAGE="analyze", SLURM_ARRAY_TASK_ID="3") == ["--stage", "analyze"]
    assert arguments(SLURM_ARRAY_TASK_ID="3") == ["--array-index", "3"]


@pytest.mark.parametrize(
    "variables",
    [{"SAVE_VIZ": "maybe"}, {"TASK_ID": "0,3"}, {"CHECKPOINT": "a", "CKPT_PATH": "b"}],
)
def test_values_that_cannot_be(variables):
    with pytest.raises(BadArgument, match=next(iter(variables))):
        arguments(**variables)


@pytest.mark.parametrize(
    ("words", "named"),
    [
        (["--task-suite", "all", "--output", "a.zarr"], "all"),
        (["--task-suite", "all", "--array-index", "40"], "--array=0-39"),
        (["--task-id", "3", "11"], "Task 11 "),
    ],
)
@pytest.mark.parametrize("program", ["evaluate-attention-ratio", "evaluate-attention-ratio-cosmos"])
def test_mistakes_in_the_commands(tmp_path, monkeypatch, capsys, program, words, named):
    monkeypatch.chdir(tmp_path)
    try:
        code = evaluate(program, words)
    except SystemExit as stopped:
        code = stopped.code
    said = capsys.readouterr().err
    assert code == 2
    assert named in said
    assert said.count("\n") == 1
    assert os.listdir(tmp_path) == []


def test_the_analysis_of_one_task_reads_that_task_alone(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    words = ["--checkpoint", "pi05_cubes", "--task-suite", "cubes", "--task-id", "1", "--stage", "analyze"]
    places = ["--output", str(vla_attention.example("cubes")), "--output-dir", "results"]
    assert evaluate("evaluate-attention-ratio", [*words, *places, "--layers", "0"]) == 0
    found = json.loads(Path("results/attention_ratio_results_cubes.json").read_text(encoding="utf-8"))
    assert [episode["task_id"] for episode in found] == [1, 1]
