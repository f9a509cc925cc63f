"""Opening a store whose recording a budget chooses, while other processes may do the same."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest

from vla_attention.capture.budget.budget import Choice, Fixed
from vla_attention.capture.budget.budgeted_recording import Budget, BudgetedRecording, open_within_budget
from vla_attention.capture.environments.base import EnvironmentSettings
from vla_attention.capture.interventions.run_changes import RunChanges
from vla_attention.capture.store.disk_estimate import DiskEstimate
from vla_attention.capture.store.store_writer import open_run
from vla_attention.schemas.interventions import Interventions
from vla_attention.schemas.stores.store_format import Recording, RootAttributes, RunMismatch
from vla_attention.testing.stores import StoreSpec, root_attributes

ATTRIBUTES = root_attributes(StoreSpec(layers=(0, 1, 2, 3), heads=(0, 1)))
ESTIMATE = DiskEstimate(1, 2, 3)


class Chooses(BudgetedRecording):
    """Chooses the candidate of a number, and does something else before that is known."""

    def choose(self, attributes: RootAttributes) -> Choice:
        cast(Any, self.policy).meanwhile()
        recording = self.candidates(attributes.recording)[cast(Any, self.policy).number]
        return Choice(recording, ESTIMATE, ("Chosen.",))


def chooses(number: int, meanwhile: Any = lambda: None, fixed: Fixed | None = None) -> Chooses:
    policy = cast(Any, SimpleNamespace(num_denoise_steps=10, number=number, meanwhile=meanwhile))
    changes = RunChanges(Interventions(), {})
    return Chooses(Budget(1, fixed or Fixed(), 1), policy, (), EnvironmentSettings(), changes, lambda: None)


def never() -> None:
    raise AssertionError("nothing is tried where the recording is known")


def recordings() -> tuple[Recording, ...]:
    return chooses(0).candidates(ATTRIBUTES.recording)


def test_a_new_store_has_the_chosen_recording(tmp_path: Path, capsys):
    store, estimate = open_within_budget(tmp_path / "a.zarr", ATTRIBUTES, "new", chooses(3))
    assert store.attributes.recording == recordings()[3]
    assert estimate == ESTIMATE
    assert "Chosen." in capsys.readouterr().out


def test_without_a_budget_the_recording_is_the_one_that_was_asked_for(tmp_path: Path):
    store, estimate = open_within_budget(tmp_path / "a.zarr", ATTRIBUTES, "new", None)
    assert (store.attributes.recording, estimate) == (ATTRIBUTES.recording, None)


def test_a_store_that_is_continued_keeps_its_recording(tmp_path: Path):
    path = tmp_path / "a.zarr"
    open_run(path, replace(ATTRIBUTES, recording=recordings()[5]), "new")
    store, estimate = open_within_budget(path, ATTRIBUTES, "resume", chooses(0, never))
    assert (store.attributes.recording, estimate) == (recordings()[5], None)


def test_two_processes_that_choose_at_once_keep_the_choice_of_the_first(tmp_path: Path):
    path = tmp_path / "a.zarr"
    first = replace(ATTRIBUTES, recording=recordings()[6])
    store, _ = open_within_budget(path, ATTRIBUTES, "resume", chooses(2, lambda: open_run(path, first, "new")))
    assert store.attributes.recording == recordings()[6]


def test_a_store_of_another_recording_is_refused_by_name(tmp_path: Path):
    path = tmp_path / "a.zarr"
    other = replace(ATTRIBUTES.recording, mantissa_bits=16)
    open_run(path, replace(ATTRIBUTES, recording=other), "new")
    with pytest.raises(RunMismatch, match=r"its recording\.\w+ is"):
        open_within_budget(path, ATTRIBUTES, "resume", chooses(0, never))
    for mode, choice in (("new", 1), ("overwrite", 2)):  # nothing was recorded there
        replaced, _ = open_within_budget(path, ATTRIBUTES, mode, chooses(choice))
        assert replaced.attributes.recording == recordings()[choice]
