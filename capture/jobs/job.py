"""Who is running: this process, and the SLURM job that it belongs to, if any.

Nothing here is stored in the store itself: episodes are the same bytes whoever made them, and what people share does not name their
machines. It goes into the small files beside the store (see `vla_attention.capture.jobs.run_records` and `vla_attention.capture.jobs.claims`).
"""

from __future__ import annotations

import os
import socket
import subprocess
import uuid
from dataclasses import dataclass
from pathlib import Path

#: States in which a job may ask to be put back into the queue: a cancelled job that did so would rise from the dead.
_ALIVE_STATES = ("RUNNING",)


@dataclass(frozen=True)
class Worker:
    """A process that captures.

    `process_start` (clock ticks since boot) tells a process from a later one with the same number; `process_space` is the namespace
    of process numbers (containers have their own). `slurm_job` is SLURM's own id, which an array task does not share and which
    survives a requeue; `restarts` counts the requeues. Empty strings and 0 where something is not known.
    """

    tag: str
    host: str
    process: int
    process_start: str
    process_space: str
    slurm_job: str = ""
    job_name: str = ""
    restarts: int = 0

    def described(self) -> str:
        """For people: host, and job or process."""
        return f"{self.host} ({f'job {self.job_name}' if self.slurm_job else f'process {self.process}'})"


def this_worker() -> Worker:
    """The process that calls."""
    environment, process = os.environ, os.getpid()
    job = environment.get("SLURM_JOB_ID", "")
    array, index = environment.get("SLURM_ARRAY_JOB_ID"), environment.get("SLURM_ARRAY_TASK_ID")
    restarts = environment.get("SLURM_RESTART_COUNT", "0")
    host = socket.gethostname()
    return Worker(
        tag=f"{host}-{process}-{uuid.uuid4().hex[:8]}",
        host=host,
        process=process,
        process_start=_process_start(process),
        process_space=_process_space(),
        slurm_job=job,
        job_name=f"{array}_{index}" if array and index else job,
        restarts=int(restarts) if restarts.isdigit() else 0,
    )


def is_known_dead(other: Worker, this: Worker) -> bool:
    """Whether it is certain that a worker has ended: a process of this machine that is gone, or this very job before its requeue.

    False means "cannot tell", not "alive".
    """
    if other.slurm_job and other.slurm_job == this.slurm_job and other.restarts < this.restarts:
        return True  # SLURM starts a requeued job only after the earlier one has ended
    if (other.host, other.process_space) != (this.host, this.process_space) or not other.process_start:
        return False
    return _process_start(other.process) != other.process_start


def array_task_ids() -> tuple[int, ...]:
    """Every index of the SLURM array that this process belongs to; empty outside of one, and when they cannot be told.

    SLURM says the smallest and largest index, the step and the number of tasks. A list such as 0,3,7 does not follow from them.
    """
    names = ("SLURM_ARRAY_TASK_MIN", "SLURM_ARRAY_TASK_MAX", "SLURM_ARRAY_TASK_STEP", "SLURM_ARRAY_TASK_COUNT")
    values = [os.environ.get(name, "") for name in names]
    if not all(value.isdigit() for value in values):
        return ()
    first, last, step, count = map(int, values)
    indices = tuple(range(first, last + 1, max(step, 1)))
    return indices if len(indices) == count else ()


def ask_for_requeue(worker: Worker, most_restarts: int) -> str:
    """Put this SLURM job back into the queue when it is still meant to run; returns the sentence to print, empty without SLURM.

    A job that was told to stop because its time is nearly over is still running for SLURM, and is requeued. One that was cancelled
    is not, and one that SLURM preempts with requeueing is requeued by SLURM.
    """
    if not worker.slurm_job:
        return ""
    if worker.restarts >= most_restarts:
        return (
            f"Not requeued: job {worker.job_name} has been requeued {worker.restarts} times; submit it again to go on."
        )
    try:
        shown = _slurm("scontrol", "show", "job", worker.job_name)
    except (OSError, subprocess.SubprocessError) as error:
        return (
            f"Not requeued: SLURM could not be asked about job {worker.job_name} ({error}); submit it again to go on."
        )
    state = next((word.partition("=")[2] for word in shown.split() if word.startswith("JobState=")), "unknown")
    if state not in _ALIVE_STATES:
        return f"For SLURM, job {worker.job_name} is {state} already: whether it comes back is decided there."
    try:
        _slurm("scontrol", "requeue", worker.job_name)
    except (OSError, subprocess.SubprocessError) as error:
        return f"Not requeued: SLURM refused to requeue job {worker.job_name} ({error}); submit it again to go on."
    return f"Job {worker.job_name} is back in the queue and goes on with what is missing."


def _slurm(*command: str) -> str:
    done = subprocess.run(command, capture_output=True, text=True, timeout=20, check=False)
    if done.returncode:
        raise subprocess.SubprocessError((done.stderr or done.stdout).strip() or f"{command[0]} failed")
    return done.stdout


def _process_start(process: int) -> str:
    """When a process of this machine began; empty when there is none."""
    try:
        stat = Path(f"/proc/{process}/stat").read_text()
    except OSError:
        return ""
    # The second field is the program's name in parentheses and may hold anything; the start is the 22nd. A zombie has ended.
    state, *fields = stat.rpartition(")")[2].split()
    return "" if state in ("Z", "X") else fields[18]


def _process_space() -> str:
    try:
        return os.readlink("/proc/self/ns/pid")
    except OSError:
        return ""
