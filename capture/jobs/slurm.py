"""Requests to SLURM: the indices of this process's array job, and another place in the queue after SIGTERM."""

from __future__ import annotations

import os
import subprocess

from vla_attention.schemas.stores.worker import Worker


def array_task_ids() -> tuple[int, ...]:
    """Return all indices of the SLURM array of this process; empty without an array, and if SLURM does not determine
    them.

    SLURM gives the smallest and largest index, the step and the number of tasks. They do not determine a list such as
    0,3,7.
    """
    names = ("SLURM_ARRAY_TASK_MIN", "SLURM_ARRAY_TASK_MAX", "SLURM_ARRAY_TASK_STEP", "SLURM_ARRAY_TASK_COUNT")
    values = [os.environ.get(name, "") for name in names]
    if not all(value.isdigit() for value in values):
        return ()
    first, last, step, count = map(int, values)
    indices = tuple(range(first, last + 1, max(step, 1)))
    return indices if len(indices) == count else ()


def ask_for_requeue(worker: Worker, most_restarts: int) -> str:
    """Put this SLURM job back into the queue if SLURM still lists it as running.

    A job whose time limit is near gets SIGTERM while SLURM lists it as running: it is requeued. A cancelled job is not.
    A job that SLURM preempts with requeueing is requeued by SLURM itself.

    Returns:
        A sentence about the outcome for the terminal; empty without SLURM.
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
        return f"Not requeued: SLURM did not answer about job {worker.job_name} ({error}); submit it again to go on."
    state = next((field.partition("=")[2] for field in shown.split() if field.startswith("JobState=")), "unknown")
    if state != "RUNNING":  # a cancelled job must stay cancelled
        return f"Not requeued: SLURM lists job {worker.job_name} as {state} and decides whether it starts again."
    try:
        _slurm("scontrol", "requeue", worker.job_name)
    except (OSError, subprocess.SubprocessError) as error:
        return f"Not requeued: SLURM refused to requeue job {worker.job_name} ({error}); submit it again to go on."
    return f"Job {worker.job_name} is back in the queue and goes on with the missing episodes."


def _slurm(*command: str) -> str:
    done = subprocess.run(command, capture_output=True, text=True, timeout=20, check=False)
    if done.returncode:
        raise subprocess.SubprocessError((done.stderr or done.stdout).strip() or f"{command[0]} failed")
    return done.stdout
