"""Episodes on the engine of captures: its simulation of an episode, its processes, and its rule for trying again."""

from __future__ import annotations

import contextlib
import sys
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from contextlib import AbstractContextManager, ExitStack, closing
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from typing import Any, Generic, TypeVar

from tqdm import tqdm

from vla_attention.capture.engine.faults import Faults
from vla_attention.capture.engine.simulation import Advanced, Simulation, SimulationFailed
from vla_attention.capture.engine.simulator_process import Failed, Server, SimulatorProcess
from vla_attention.capture.environments.cubes.environment import CubesEnvironment
from vla_attention.capture.environments.cubes.tasks import CubeTask
from vla_attention.capture.environments.episode_protocol import OPENPI, WAIT_STEPS
from vla_attention.schemas.errors import UserError
from vla_attention.schemas.stores.store_format import Protocol

Job = TypeVar("Job")
Result = TypeVar("Result")
#: Makes what a process needs, in the process, and gives what does a job there. It is of a module, or a partial of one.
Begin = Callable[[], AbstractContextManager[Callable[[Job], Iterable[Result]]]]


def cubes_protocol(suite: str, seed: int, replan_steps: int, max_steps: int) -> Protocol:
    """Return how episodes are run: as in a capture of `cubes`, but for the numbers that are given."""
    return Protocol(
        name=OPENPI.name,
        suite=suite,
        seed=seed,
        wait_steps=WAIT_STEPS,
        replan_steps=replan_steps,
        max_steps=max_steps,
        image_size=OPENPI.image_size,
    )


def begin_episode(
    environment: CubesEnvironment, task: CubeTask, state: int, protocol: Protocol
) -> tuple[Simulation, Advanced]:
    """Begin an episode and wait; the result has what is seen after the last waiting step."""
    environment.give_task(task)
    simulation = Simulation(environment, protocol, cameras=())
    simulation.begin(state, f"episode {state} of task {task.name}")
    return simulation, simulation.wait()


class WorkRefused(UserError):
    """A process found a mistake of the user in its work; the message is its own."""


@dataclass(frozen=True)
class _Done:
    """Tells that all results of a job were sent."""


@dataclass(frozen=True)
class _Setup(Generic[Job, Result]):
    begin: Begin[Job, Result]

    def server(self, connection: Connection) -> Server:
        return _JobServer(self.begin, connection)


@dataclass
class _JobServer(Generic[Job, Result]):
    begin: Begin[Job, Result]
    connection: Connection
    title: str = "the first job"

    def serve(self) -> None:
        with self.begin() as do:
            while True:
                job: Job = self.connection.recv()
                self.title = f"job {job}"
                for result in do(job):
                    self.connection.send(result)
                self.connection.send(_Done())


def share_among_processes(
    begin: Begin[Job, Result],
    jobs: Sequence[Job],
    workers: int,
    receive: Callable[[Result], None],
    progress: tqdm[Any],
) -> bool:
    """Let `workers` processes do the jobs in their order; returns whether all were done.

    receive: is given the results of every job that was done. progress: counts results. A job whose simulator fails, or
    whose process dies, is done once more by another process, as the engine does with episodes.

    Raises:
        WorkRefused: a process raised a `UserError`; the others are ended.
    """
    left, faults = deque(jobs), Faults()
    idle: list[SimulatorProcess] = []
    running: dict[Connection, tuple[SimulatorProcess, Job, list[Result]]] = {}
    with ExitStack() as stack:
        while left or running:
            while left and len(running) < workers:
                process = idle.pop() if idle else stack.enter_context(closing(SimulatorProcess(_Setup(begin))))
                job = left.popleft()
                running[process.connection] = (process, job, [])
                with contextlib.suppress(OSError):  # it has died, and reading says so
                    process.connection.send(job)
            for connection in wait(list(running)):
                assert isinstance(connection, Connection)
                process, job, results = running[connection]
                try:
                    answer = connection.recv()
                except (EOFError, OSError):
                    answer = Failed(f"The process of job {job} ended ({process.how_it_ended()}).", expected=False)
                if isinstance(answer, Failed):
                    if answer.expected:
                        raise WorkRefused(answer.sentence)
                    del running[connection]
                    process.close()
                    progress.update(-len(results))
                    again = faults.note(str(job), SimulationFailed(answer.sentence, answer.reason))
                    what_next = "begins again" if again else "is left out"
                    progress.write(f"{answer.sentence} The job {what_next}.", file=sys.stderr)
                    if again:
                        left.appendleft(job)
                elif isinstance(answer, _Done):
                    del running[connection]
                    idle.append(process)
                    faults.note_recorded()
                    for result in results:
                        receive(result)
                else:
                    results.append(answer)
                    progress.update()
    return not faults.dropped
