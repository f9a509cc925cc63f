"""The recording of a run with `--budget`: a trial says what each choice takes, and the largest that fits is taken."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from vla_attention.capture.budget.budget import Choice, Fixed, choose_recording, recordings_by_size
from vla_attention.capture.budget.trial import run_trial, spread
from vla_attention.capture.effects.measurement import EffectMeasurement
from vla_attention.capture.environments.base import EnvironmentSettings, Task
from vla_attention.capture.interventions.run_changes import RunChanges
from vla_attention.capture.policies.policy import Policy
from vla_attention.capture.rollout.episode import max_replans
from vla_attention.capture.engine.progress import say
from vla_attention.capture.engine.simulation import StopCheck
from vla_attention.capture.store.disk_estimate import DiskEstimate, mean_size
from vla_attention.capture.store.store_root import read_existing_root
from vla_attention.capture.store.store_writer import RunStore, WriteMode, open_run
from vla_attention.schemas.stores.store_format import Recording, RootAttributes, RunMismatch

#: Tasks whose first replans are tried: pictures of one scene may take twice as much as those of another.
TRIED_TASKS = 3


@dataclass(frozen=True)
class Budget:
    """A number of bytes for a run of `episodes` episodes, and what of the recording is not open to choice."""

    bytes: int
    fixed: Fixed
    episodes: int


@dataclass(frozen=True)
class BudgetedRecording:
    """What a recording within a budget is chosen with: the first replans of `tasks` are tried, without being stored."""

    budget: Budget
    policy: Policy
    tasks: Sequence[Task]
    settings: EnvironmentSettings
    changes: RunChanges
    check: StopCheck
    effects: EffectMeasurement | None = None

    def candidates(self, asked: Recording) -> tuple[Recording, ...]:
        """Return the recordings to choose from, the largest first."""
        return recordings_by_size(asked, self.policy.num_denoise_steps, self.budget.fixed)

    def choose(self, attributes: RootAttributes) -> Choice:
        """Return the largest recording that fits.

        Raises:
            BudgetTooSmall: nothing fits.
        """
        candidates = self.candidates(attributes.recording)
        largest = replace(attributes, recording=candidates[0])
        samples = [
            run_trial(self.policy, largest, task, self.settings, self.changes, self.check, effects=self.effects).sample
            for task in spread(self.tasks, TRIED_TASKS)
        ]
        replans = max_replans(attributes.protocol)

        def estimate_of(recording: Recording) -> DiskEstimate:
            return mean_size([sample.size(recording) for sample in samples]).estimate(replans, self.budget.episodes)

        return choose_recording(candidates, self.budget.bytes, estimate_of, self.policy.num_denoise_steps)


def open_within_budget(
    path: Path, attributes: RootAttributes, mode: WriteMode, budgeted: BudgetedRecording | None
) -> tuple[RunStore, DiskEstimate | None]:
    """Open the store of a run with the recording that its budget allows; also return the size, where it was measured.

    A store that is to be continued keeps its recording: another process of the same run has chosen it.
    """
    if budgeted is None:
        return open_run(path, attributes, mode), None
    if mode == "resume" and path.exists():
        return _continue(path, attributes, budgeted), None
    say("Trying the first replans, to measure what they take ...")
    choice = budgeted.choose(attributes)
    try:
        store = open_run(path, replace(attributes, recording=choice.recording), mode)
    except RunMismatch:
        # Meanwhile another process of the same job array has made the store, with a choice of its own.
        return _continue(path, attributes, budgeted), None
    for line in choice.lines:
        say(line)
    return store, choice.estimate


def _continue(path: Path, attributes: RootAttributes, budgeted: BudgetedRecording) -> RunStore:
    existing = read_existing_root(path).recording
    if existing not in budgeted.candidates(attributes.recording):
        return open_run(path, attributes, "resume")  # which names what differs
    say("The recording was chosen when the store was made, and --budget does not change it.")
    return open_run(path, replace(attributes, recording=existing), "resume")
