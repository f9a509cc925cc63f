"""A process that simulates: it gets an episode and then actions, and answers with what the simulator gave.

`SimulatorProcess` is its other end, in the process of the policy. The process begins anew instead of being forked: an
OpenGL context does not survive a fork. Every process draws with a context and one thread of its own.

What is sent first decides what the process does: with a `SimulatorSetup` it simulates for a policy.
"""

from __future__ import annotations

import atexit
import contextlib
import gc
import os
import select
import shutil
import subprocess
import sys
import tempfile
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from multiprocessing import Pipe
from multiprocessing.connection import Connection
from typing import Any
from typing import Protocol as Interface

import numpy as np
from numpy.typing import NDArray

from vla_attention.capture.engine.simulation import (
    CameraPatches,
    Simulation,
    SimulationFailed,
    StopCheck,
    failure,
    naming_the_simulator,
)
from vla_attention.capture.environments.base import Environment, EnvironmentSettings, SharesResets, Suite
from vla_attention.capture.environments.suites import make_environment
from vla_attention.schemas.errors import UserError
from vla_attention.schemas.stores.store_format import Protocol, episode_name
from vla_attention.schemas.threads import OTHER_LIBRARIES

#: Mesa's renderer then draws in the thread that asks for a picture. With a thread of its own, which the first one waits
#: for, the steps between two policy calls take a tenth longer.
_DRAWS_ITSELF = {"LP_NUM_THREADS": "0"}
#: How far simulators stand back where there are more processes than cores: all of them wait for the policy's process.
_NICENESS = 5
#: Seconds that a process gets to end by itself.
_END_WITHIN_S = 2.0
#: Milliseconds between two looks whether the policy's process lives.
_LOOK_EVERY_MS = 1000
#: The paths of modules are those of the first process, which may have got some while it ran.
_BOOT = (
    "import sys; sys.path[:] = sys.argv[3:]; "
    "from vla_attention.capture.engine.simulator_process import main; main(int(sys.argv[1]), sys.argv[2])"
)


class Server(Interface):
    """A process's own side. title: what it does now, for messages."""

    title: str

    def serve(self) -> None:
        """Answer until the other end closes."""


class Setup(Interface):
    """What a process is sent first, once."""

    def server(self, connection: Connection) -> Server:
        """Return the process's own side; called in the process."""


@dataclass(frozen=True)
class SimulatorSetup:
    """What a process needs to know to simulate for a policy elsewhere."""

    suite: Suite
    settings: EnvironmentSettings
    protocol: Protocol
    cameras: tuple[CameraPatches, ...]

    def server(self, connection: Connection) -> Server:
        """Return what takes `BeginEpisode` and `Execute`."""
        return _ProcessServer(connection, self)


@dataclass(frozen=True)
class BeginEpisode:
    """Asks for the beginning of an episode, with its waiting steps.

    task_id, state: in whose scene it begins, and the number of the initial state. title: its name in messages. resets:
    what another simulator's `KnownResets` told about the task. told: the task whose goal ends it; None: the same.
    """

    task_id: int
    state: int
    title: str
    resets: Any = None
    told: int | None = None


@dataclass(frozen=True)
class Execute:
    """Asks for the execution of actions (step, 7); with `observe` the last one is observed."""

    actions: NDArray[np.float64]
    observe: bool


@dataclass(frozen=True)
class ResetsFirst:
    """Tells that so many resets of earlier episodes are made before an episode (its name) of a task begins."""

    number: int
    task_id: int
    episode: str


@dataclass(frozen=True)
class KnownResets:
    """Tells what the environment of a task knows about its resets; see `SharesResets`."""

    resets: Sequence[Any]


@dataclass(frozen=True)
class Failed:
    """Tells that the simulator failed, in one sentence. expected: a mistake of the user, which all episodes meet.

    reason: as in `SimulationFailed`.
    """

    sentence: str
    expected: bool
    reason: str = ""


class SimulatorProcess:
    """A running process. `connection` has its answers: `ResetsFirst`, `KnownResets`, `Begun`, `Advanced`, `Failed`."""

    def __init__(self, setup: Setup) -> None:
        self.connection, theirs = Pipe()
        one_thread = dict.fromkeys(("OMP_NUM_THREADS", *OTHER_LIBRARIES), "1") | _DRAWS_ITSELF
        # Its temporary files are removed here: it is killed, and removes none. When this process is killed, it does.
        self._temporary = tempfile.TemporaryDirectory(prefix="vla-simulator-", ignore_cleanup_errors=True)
        with theirs:
            # A process group of its own: Ctrl-C reaches the policy's process alone, which ends this one. It also ends
            # when the other end of the connection closes, however the policy's process ended.
            self._process = subprocess.Popen(
                [sys.executable, "-c", _BOOT, str(theirs.fileno()), self._temporary.name, *sys.path],
                stdin=subprocess.DEVNULL,
                stdout=sys.stderr.fileno() if _has_descriptor(sys.stderr) else None,
                pass_fds=[theirs.fileno()],
                env=os.environ | one_thread | {"TMPDIR": self._temporary.name},
                process_group=0,
            )
        self.ask(setup)

    @property
    def number(self) -> int:
        """The number of the process."""
        return self._process.pid

    def ask(self, message: Any) -> None:
        """Send what it answers: to `BeginEpisode` with `Begun` and, after the waiting steps, `Advanced`."""
        with contextlib.suppress(OSError):  # it has died, and reading says so
            self.connection.send(message)

    def has_answer(self) -> bool:
        """Whether it has answered, or has ended."""
        try:
            return self.connection.poll()
        except OSError:
            return True  # `receive` says so

    def receive(self) -> Any:
        """Return its next answer; `EOFError` or `OSError` when it has ended."""
        return self.connection.recv()

    def how_it_ended(self) -> str:
        """Wait for the end of a process whose connection has closed, and describe it."""
        try:
            code = self._process.wait(_END_WITHIN_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            code = self._process.wait()
        return f"killed by signal {-code}" if code < 0 else f"exit code {code}"

    def close(self) -> None:
        """End the process. One that the operating system cannot end yet, on a disk that hangs, is not waited for."""
        self.connection.close()
        self._process.kill()
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(_END_WITHIN_S)
        self._temporary.cleanup()


def _has_descriptor(stream: Any) -> bool:
    try:
        stream.fileno()
    except (AttributeError, OSError, ValueError):
        return False
    return True


class SimulatorServer:
    """Simulates for a policy, and answers with `send`.

    check: called before every environment step; an exception that it raises ends the episode.
    """

    def __init__(self, send: Callable[[object], None], setup: SimulatorSetup, check: StopCheck = lambda: None) -> None:
        self.send, self.setup, self.check = send, setup, check
        self.environment: Environment | None = None
        self.task_id: int | None = None

    def answer(self, request: BeginEpisode | Execute) -> None:
        """Begin an episode, with its waiting steps, or execute actions."""
        if isinstance(request, Execute):
            self.send(self.simulation.advance(request.actions, request.observe))
            return
        with naming_the_simulator(request.title):
            self._begin(request)

    def _begin(self, request: BeginEpisode) -> None:
        environment, seed = self._environment_of(request.task_id), self.setup.protocol.seed
        shared = environment if isinstance(environment, SharesResets) else None
        if shared is not None and request.resets is not None:
            shared.learn_resets(seed, request.resets)
        missing = environment.missing_resets(request.state, seed)
        if missing:
            self.send(ResetsFirst(missing, request.task_id, episode_name(request.task_id, request.state)))
        self.simulation = Simulation(environment, self.setup.protocol, self.setup.cameras, self.check)
        begun = self.simulation.begin(request.state, request.title, request.told)
        if shared is not None:
            self.send(KnownResets(shared.known_resets(seed)))
        self.send(begun)
        self.send(self.simulation.wait())

    def close(self) -> None:
        """Close the environment."""
        environment, self.environment = self.environment, None
        if environment is not None:
            environment.close()

    def made(self, task_id: int) -> Environment:
        """Make the environment of a task."""
        return make_environment(self.setup.suite, task_id, self.setup.settings)

    def _environment_of(self, task_id: int) -> Environment:
        if self.environment is None or self.task_id != task_id:
            self.close()
            self.environment, self.task_id = self.made(task_id), task_id
        return self.environment


class _ProcessServer(SimulatorServer):
    """Simulates for a policy at the other end of a connection."""

    title = "an episode"  # an episode's own errors have its title

    def __init__(self, connection: Connection, setup: SimulatorSetup) -> None:
        super().__init__(connection.send, setup)
        self.connection = connection

    def serve(self) -> None:
        """Answer until the other end closes."""
        while True:
            self.answer(self.connection.recv())

    def made(self, task_id: int) -> Environment:
        """Make the environment of a task.

        Every reset of robosuite collects garbage; what lives as long as the scene need not be looked at again.
        """
        gc.unfreeze()
        environment = super().made(task_id)
        gc.freeze()
        return environment


def _end_with_the_policy(descriptor: int, temporary: str) -> None:
    """End this process with the policy's, also in the middle of a reset, which takes minutes where a disk is slow."""
    policy, other_end = os.getppid(), select.poll()
    other_end.register(descriptor, 0)  # its closing is told in any case
    # What the policy's process forked may hold the other end after it.
    while not other_end.poll(_LOOK_EVERY_MS) and os.getppid() == policy:
        pass
    shutil.rmtree(temporary, ignore_errors=True)
    os._exit(0)


def main(descriptor: int, temporary: str | None = None) -> None:
    """Simulate for the process at the other end of a connection, until that end closes.

    temporary: a folder of this process alone, which is removed when it ends by itself.
    """
    if temporary is not None:
        # What is registered first is called last: others remove their files in it before.
        atexit.register(shutil.rmtree, temporary, ignore_errors=True)
        threading.Thread(target=_end_with_the_policy, args=(descriptor, temporary), daemon=True).start()
    connection = Connection(descriptor)
    os.nice(_NICENESS)
    try:
        server = connection.recv().server(connection)
        try:
            server.serve()
        except (EOFError, ConnectionError):
            raise
        except SimulationFailed as error:
            connection.send(Failed(str(error), False, error.reason))
        except UserError as error:
            connection.send(Failed(str(error), expected=True))
        except Exception as error:
            failed = failure(server.title, error)
            connection.send(Failed(str(failed), False, failed.reason))
    except (EOFError, ConnectionError):
        return  # the policy's process has ended, or needs this one no more
