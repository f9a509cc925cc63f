"""The number of threads from faked machines."""

from __future__ import annotations

from pathlib import Path

import pytest

from vla_attention.schemas.errors import BadArgument
from vla_attention.schemas.threads import choose_threads, cpu_quota

V2_MOUNT = "30 23 0:26 {tree} /sys/fs/cgroup rw,nosuid shared:4 - cgroup2 cgroup2 rw,nsdelegate\n"


@pytest.mark.parametrize(
    ("given", "environment", "cores", "quota", "number", "source"),
    [
        (None, {}, 2, None, 2, "the cores that this process may use"),
        (None, {}, 8, 3.5, 3, "the CPU quota of its control group"),
        (None, {}, 8, 0.5, 1, "the CPU quota of its control group"),
        (None, {}, 8, 64.0, 8, "the cores that this process may use"),
        (None, {"SLURM_CPUS_PER_TASK": "4", "SLURM_CPUS_ON_NODE": "32"}, 64, None, 4, "SLURM_CPUS_PER_TASK"),
        (None, {"SLURM_CPUS_PER_TASK": "64"}, 8, None, 8, "the cores that this process may use"),
        (None, {"SLURM_CPUS_ON_NODE": "6"}, 64, None, 6, "SLURM_CPUS_ON_NODE"),
        (None, {"SLURM_CPUS_ON_NODE": "8", "SLURM_STEP_TASKS_PER_NODE": "4(x2),1"}, 64, None, 2, "SLURM_CPUS_ON_NODE"),
        (None, {"OMP_NUM_THREADS": "16", "SLURM_CPUS_PER_TASK": "4"}, 8, 1.0, 16, "OMP_NUM_THREADS"),
        (None, {"OMP_NUM_THREADS": " 3,2 "}, 8, None, 3, "OMP_NUM_THREADS"),
        (None, {"OMP_NUM_THREADS": ""}, 8, None, 8, "the cores that this process may use"),
        (5, {"OMP_NUM_THREADS": "16", "SLURM_CPUS_PER_TASK": "4"}, 8, 1.0, 5, "--threads"),
    ],
)
def test_the_order_of_precedence(given, environment, cores, quota, number, source):
    threads = choose_threads(given, environment, cores, quota)
    assert (threads.number, threads.source) == (number, source)
    assert threads.describe().startswith(f"Threads: {number} ({source}")


@pytest.mark.parametrize(("given", "by_user"), [(0, ""), (-2, "4"), (None, "many"), (None, "0")])
def test_a_wrong_number_is_refused_by_name(given, by_user):
    with pytest.raises(BadArgument, match=r"--threads|OMP_NUM_THREADS is") as error:
        choose_threads(given, {"OMP_NUM_THREADS": by_user}, 8, None)
    assert "at least 1" in str(error.value)


def machine(root: Path, own: str, mounts: str, files: dict[str, str]) -> Path:
    """A folder with the files of /proc and /sys that state the control groups of a process."""
    for name, content in {"proc/self/cgroup": own, "proc/self/mountinfo": mounts, **files}.items():
        file = root / name
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(content)
    return root


def test_the_smallest_quota_on_the_way_up_counts(tmp_path):
    files = {
        "sys/fs/cgroup/job_7/cpu.max": "250000 100000\n",
        "sys/fs/cgroup/job_7/step_0/cpu.max": "max 100000\n",
        "sys/fs/cgroup/job_7/step_0/task_0/cpu.max": "400000 100000\n",
        "sys/fs/cgroup/job_8/cpu.max": "100000 100000\n",  # of other processes
    }
    root = machine(tmp_path, "0::/job_7/step_0/task_0\n", V2_MOUNT.format(tree="/"), files)
    assert cpu_quota(root) == 2.5
