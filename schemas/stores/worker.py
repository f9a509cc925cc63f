"""Workers: the processes that capture, and the SLURM jobs that started them.

A store holds nothing about workers. Its episodes have the same bytes on every machine, and people who share a store do
not share the names of their machines. This information is only in locks (`locks.py`) and in the logs beside the store
(`worker_log.py`).
"""

from __future__ import annotations

import os
import socket
import uuid
from pathlib import Path

from vla_attention.schemas.jsonable import Document


class Worker(Document, frozen=True):
    """A process that captures. Unknown values are empty strings and 0.

    tag: unique among all processes of all machines.
    process_start: clock ticks from the boot of the machine to the start of the process. It distinguishes a process from
        a later one with the same number.
    process_space: where the process number holds: in one boot of one machine, and there in one namespace (every
        container has its own).
    slurm_job: SLURM's own id. Every task of an array has a different one, and it stays the same after a requeue.
    restarts: number of requeues.
    """

    tag: str
    host: str
    process: int
    process_start: str
    process_space: str
    slurm_job: str = ""
    job_name: str = ""
    restarts: int = 0

    def describe(self) -> str:
        """Return host and job, or host and process, as text."""
        return f"{self.host} ({f'job {self.job_name}' if self.slurm_job else f'process {self.process}'})"


def this_worker() -> Worker:
    """Return the worker of the calling process."""
    environment, process = os.environ, os.getpid()
    job = environment.get("SLURM_JOB_ID", "")
    array, index = environment.get("SLURM_ARRAY_JOB_ID"), environment.get("SLURM_ARRAY_TASK_ID")
    restarts = environment.get("SLURM_RESTART_COUNT", "0")
    return Worker(
        tag=uuid.uuid4().hex,
        host=socket.gethostname(),
        process=process,
        process_start=_process_start(process),
        process_space=_process_space(),
        slurm_job=job,
        job_name=f"{array}_{index}" if array and index else job,
        restarts=int(restarts) if restarts.isdigit() else 0,
    )


def is_known_dead(other: Worker, this: Worker) -> bool:
    """Return whether a worker has certainly ended; False means that it may have ended or not.

    This is certain for a process of this machine that no longer exists, and for this very job before its requeue.
    """
    if other.slurm_job and other.slurm_job == this.slurm_job and other.restarts < this.restarts:
        return True  # SLURM starts a requeued job only after the end of the earlier one
    known = other.process_start and other.process_space
    if not known or (other.host, other.process_space) != (this.host, this.process_space):
        return False
    return _process_start(other.process) != other.process_start


def _process_space() -> str:
    """Where the numbers of this machine's processes hold; empty where the system does not say it.

    It is the number of the boot, drawn at random when the machine started, and the namespace of process numbers, of
    which a container may have its own: `4f0d2f0e-... pid:[4026531836]`. The name of a host does not tell two nodes
    apart: nodes that start from one image may share it, and all machines have the same first namespace.
    """
    try:
        boot = Path("/proc/sys/kernel/random/boot_id").read_text(encoding="ascii").strip()
        return f"{boot} {os.readlink('/proc/self/ns/pid')}"
    except OSError:
        return ""


def _process_start(process: int) -> str:
    """Return the start of a process of this machine (clock ticks after boot); empty if the process does not exist."""
    try:
        stat = Path(f"/proc/{process}/stat").read_text()
    except OSError:
        return ""
    # The second field is the program's name in parentheses and may contain any character. The start is the 22nd field.
    # A process in state Z (zombie) or X has ended.
    state, *fields = stat.rpartition(")")[2].split()
    return "" if state in ("Z", "X") else fields[18]
