"""Episodes of a simulator in this process, one after the other; `pipeline.py` has simulators in others."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field

from vla_attention.capture.environments.base import Environment, EnvironmentSettings, Suite, Task
from vla_attention.capture.environments.suites import make_environment
from vla_attention.capture.rollout.episode import EpisodeRun, episode_title, record_episode
from vla_attention.capture.rollout.episode_loop import EpisodeJob, EpisodeResult, EpisodeSource, StepReport
from vla_attention.capture.rollout.simulation import SimulationFailed, naming_the_simulator


def resets_line(name: str, missing: int) -> str:
    """Return the line that says that an episode needs resets of other episodes first."""
    return f"{name}: the published furniture depends on the resets of earlier episodes; making {missing} first."


@dataclass
class SimulatorSource(EpisodeSource):
    """One environment at a time, which stays while its task has episodes."""

    suite: Suite
    settings: EnvironmentSettings
    run: EpisodeRun
    _environment: Environment | None = field(default=None, init=False)
    _task_id: int | None = field(default=None, init=False)

    def begin(self, job: EpisodeJob) -> str | None:
        """Make the environment of the task, unless it is there."""
        title = episode_title(self.run.store, job.task, job.episode_index)
        with self._closing_what_fails(), naming_the_simulator(title):
            seed = self.run.store.attributes.protocol.seed
            missing = self._environment_of(job.task).missing_resets(job.episode_index, seed)
        return resets_line(job.name, missing) if missing else None

    def record(self, job: EpisodeJob, report: StepReport) -> EpisodeResult:
        """Run the episode and commit it."""
        with self._closing_what_fails():
            return record_episode(self.run, self._environment_of(job.task), job.task, job.episode_index, report)

    def close(self) -> None:
        """Close the environment."""
        if self._environment is not None:
            environment, self._environment = self._environment, None
            environment.close()

    @contextmanager
    def _closing_what_fails(self) -> Iterator[None]:
        try:
            yield
        except SimulationFailed:  # what it has left is not to be trusted
            with suppress(Exception):
                self.close()
            raise

    def _environment_of(self, task: Task) -> Environment:
        if self._environment is None or self._task_id != task.task_id:
            self.close()
            self._environment = make_environment(self.suite, task.task_id, self.settings)
            self._task_id = task.task_id
        return self._environment
