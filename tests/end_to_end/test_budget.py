"""`--budget` on real policies and simulators: what the trial says is what is written."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from vla_attention.capture.__main__ import main as capture
from vla_attention.capture.budget.trial import Trial, run_trial
from vla_attention.capture.commands.arguments import build_parser
from vla_attention.capture.environments.base import EnvironmentSettings
from vla_attention.capture.run.capture_run import plan_run
from vla_attention.capture.run.run_settings import run_settings
from vla_attention.capture.store.disk_estimate import mean_size
from vla_attention.schemas.precision import parse_precision
from vla_attention.schemas.stores.reader import open_store

pytestmark = [pytest.mark.simulator, pytest.mark.thorough]


def trials_of(arguments: list[str], tasks: tuple[int, ...]) -> list[Trial]:
    """The trials of the run that `vla-capture` would make of these arguments."""
    parsed = build_parser().parse_args(arguments)
    settings = run_settings(parsed)
    policy = parsed.family.build(parsed, "cpu")
    plan = plan_run(settings, policy, {})
    environment = EnvironmentSettings(plan.evaluation)
    return [run_trial(policy, plan.attributes, plan.tasks[task], environment, plan.changes) for task in tasks]


def bytes_of(folder: Path) -> int:
    return sum(file.stat().st_size for file in folder.rglob("*") if file.is_file())


@pytest.mark.parametrize(
    ("words", "tried", "tasks", "precisions"),
    [
        ("pi --task-suite cubes", (0,), (3,), ("4", "10", "exact")),
        ("pi --checkpoint untrained-tiny --task-suite robosuite --max-steps 100", (0,), (1,), ("7",)),
        # Pictures are half of what this one stores, and those of the two scenes differ by a factor of two.
        ("cosmos --checkpoint untrained-tiny --task-suite robosuite --max-steps 150", (0, 2), (0, 2), ("10",)),
    ],
    ids=["pi05_cubes", "untrained-tiny", "cosmos-untrained-tiny"],
)
def test_a_few_replans_say_what_a_replan_takes(tmp_path, words, tried, tasks, precisions):
    trials = trials_of([*words.split(), "--output", str(tmp_path / "none.zarr")], tried)
    for trial in trials:
        assert len(trial.sample.records) == 8
    for precision in precisions:
        store = tmp_path / f"{precision}.zarr"
        options = ["--task-id", *map(str, tasks), "--num-episodes", "1", "--precision", precision]
        assert capture([*words.split(), *options, "--output", str(store)]) == 0
        recording = replace(trials[0].sample.attributes.recording, mantissa_bits=parse_precision(precision))
        size = mean_size([trial.sample.size(recording) for trial in trials])
        episodes = open_store(store).episodes
        predicted = sum(size.bytes_of(episode.attributes.num_replans) for episode in episodes)
        assert predicted == pytest.approx(sum(bytes_of(episode.folder) for episode in episodes), rel=0.1), precision
    assert not (tmp_path / "none.zarr").exists()
