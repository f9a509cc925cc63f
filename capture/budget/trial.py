"""A trial: the first replans of a run, timed and kept in memory. Their size and time are what the run's are made of."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import median
from typing import Any, TypeVar, cast

import numpy as np
from numpy.typing import NDArray

from vla_attention.capture.effects.measurement import EffectMeasurement
from vla_attention.capture.environments.base import Environment, EnvironmentSettings, StepResult, Task, TellsMoments
from vla_attention.capture.environments.suites import find_suite, make_environment
from vla_attention.capture.interventions.run_changes import RunChanges
from vla_attention.capture.policies.policy import Policy
from vla_attention.capture.rollout.episode import EpisodeRun, record_episode
from vla_attention.capture.engine.simulation import StopCheck
from vla_attention.capture.store.disk_estimate import FEWEST_REPLANS, SampleOfReplans
from vla_attention.capture.store.replan_records import EpisodeStart, RecordedSteps, ReplanRecord
from vla_attention.capture.store.store_writer import RunStore
from vla_attention.schemas.stores.store_format import RootAttributes

_Item = TypeVar("_Item")

#: Replans of a trial: enough that the arm has left its first pose, few enough for a full-size policy without a GPU.
TRIAL_REPLANS = 8
#: Bytes of rows that a trial may keep in memory; with `--queries all` of every step and layer it has fewer replans.
_MOST_BYTES = 1 << 30


@dataclass(frozen=True)
class Trial:
    """What the first replans of one episode were like.

    policy_seconds, step_seconds: medians of a policy call with its recording and its effects, and of a step of the
    simulator with its share of drawing. start_seconds: making the environment, its reset and the waiting steps.
    """

    sample: SampleOfReplans
    policy_seconds: float
    step_seconds: float
    start_seconds: float

    def seconds_of(self, replans: int, replan_steps: int, num_envs: int = 1) -> float:
        """Seconds of one episode of that many replans, where `num_envs` simulators run at a time beside the policy.

        The policy makes one call after another, and a simulator waits for its call and then makes its steps.
        """
        steps = replan_steps * self.step_seconds
        per_replan = max(self.policy_seconds, (self.policy_seconds + steps) / num_envs)
        return self.start_seconds / num_envs + replans * per_replan


def run_trial(
    policy: Policy,
    attributes: RootAttributes,
    task: Task,
    settings: EnvironmentSettings,
    changes: RunChanges,
    check: StopCheck = lambda: None,
    *,
    environment: Environment | None = None,
    most_replans: int = TRIAL_REPLANS,
    effects: EffectMeasurement | None = None,
) -> Trial:
    """Run the first replans of a task's first episode in an environment of its own; nothing of them is stored.

    attributes: of the run; its recording should have all that a smaller one may be chosen from. environment: instead
    of the suite's own. effects: measures those of the run, where it has some.
    """
    protocol = attributes.protocol
    replans = max(FEWEST_REPLANS, min(most_replans, _MOST_BYTES // _bytes_of_rows(attributes)))
    protocol = replace(attributes.protocol, max_steps=replans * attributes.protocol.replan_steps)
    kept, timed = _KeptEpisode(replace(attributes, protocol=protocol)), _TimedPolicy(policy)
    begun = time.perf_counter()
    simulator = environment or make_environment(find_suite(protocol.suite), task.task_id, settings)
    try:
        run = EpisodeRun(cast(Policy, timed), cast(RunStore, kept), {}, changes, check, effects=effects)
        record_episode(run, cast(Environment, _NeverSolved(simulator)), task, 0)
    finally:
        simulator.close()
    if kept.start is None:
        raise ValueError("no episode was begun")
    # The first call loads what later ones find loaded; medians leave it out.
    of_replans = np.diff(kept.times)
    of_calls = median(call.seconds for call in timed.calls)
    if effects is not None:
        of_calls += median(effects.seconds) / effects.planned.every
    return Trial(
        sample=SampleOfReplans(attributes, kept.start, kept.denoise_times, kept.records, kept.steps),
        policy_seconds=of_calls,
        step_seconds=max(0.0, float(np.median(of_replans)) - of_calls) / protocol.replan_steps,
        start_seconds=timed.calls[0].begun - begun,
    )


def spread(items: Sequence[_Item], most: int) -> list[_Item]:
    """Return at most `most` of the items, from the first to the last at equal distances."""
    if most >= len(items):
        return list(items)
    if most == 1:
        return [items[0]]
    return [items[round(number * (len(items) - 1) / (most - 1))] for number in range(most)]


def _bytes_of_rows(attributes: RootAttributes) -> int:
    """Return the bytes of the rows of one replan, in memory."""
    total = 1
    for site in attributes.sites:
        of_site = attributes.recording.of_site(site)
        cells = len(of_site.layers) * len(of_site.denoise_steps) * len(of_site.heads) * of_site.num_queries
        total += 4 * cells * site.num_keys
    return total


class _KeptEpisode:
    """Stands for a store and for the writer of its only episode: keeps the replans, and when each was added."""

    def __init__(self, attributes: RootAttributes) -> None:
        self.attributes = attributes
        self.path = Path("the trial")
        self.records: list[ReplanRecord] = []
        self.times: list[float] = []
        self.start: EpisodeStart | None = None
        self.steps: RecordedSteps | None = None
        self.denoise_times: NDArray[np.float64] = np.zeros(0)

    @contextmanager
    def episode(
        self, start: EpisodeStart, denoise_times: NDArray[np.float64], max_replans: int
    ) -> Iterator[_KeptEpisode]:
        self.start, self.denoise_times = start, denoise_times
        yield self

    def append(self, record: ReplanRecord) -> None:
        self.records.append(record)
        self.times.append(time.perf_counter())

    def commit(self, success: bool | None, num_steps: int, steps: RecordedSteps | None) -> Path:
        self.steps = steps
        return self.path


@dataclass(frozen=True)
class _Call:
    begun: float
    seconds: float


class _TimedPolicy:
    """A policy whose calls are timed."""

    def __init__(self, policy: Policy) -> None:
        self._policy = policy
        self.calls: list[_Call] = []

    def __getattr__(self, name: str) -> Any:
        return getattr(self._policy, name)

    def act(self, *arguments: Any, **options: Any) -> NDArray[np.float64]:
        begun = time.perf_counter()
        actions = self._policy.act(*arguments, **options)
        self.calls.append(_Call(begun, time.perf_counter() - begun))
        return actions


class _NeverSolved:
    """An environment that is never solved, because a trial of a good policy would end after a replan or two."""

    def __init__(self, environment: Environment) -> None:
        self._environment = environment
        if isinstance(environment, TellsMoments):
            self.bodies, self.goals, self.moment = environment.bodies, environment.goals, environment.moment

    def __getattr__(self, name: str) -> Any:
        return getattr(self._environment, name)

    def step(self, action: NDArray[np.floating], observe: bool) -> StepResult:
        return replace(self._environment.step(action, observe), success=False)
