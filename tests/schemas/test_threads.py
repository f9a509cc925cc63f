"""The number of threads from faked machines."""

from __future__ import annotations

from pathlib import Path

import pytest

from vla_attention.schemas.errors import BadArgument
from vla_attention.schemas.threads import choose_threads, cpu_quota


@pytest.mark.parametrize(
    ("given", "environment", "cores", "quota", "number", "source"),
    [
        (None, {}, 2, None, 2, "the cores that this process may use"),
        (None, {}, 8, 3.5, 3, "the CPU quota of its control group"),
        (None, {}, 8, 0.5, 1, "the CPU quota of its control group"),
        (None, {}, 8, 64.0, 8, "the cores that this process may use"),
        (None, {"SLURM_CPUS_PER_TASK": "4"}, 64, None, 4, "SLURM_CPUS_PER_TASK"),
        (None, {"SLURM_CPUS_PER_TASK": "64"}, 8, None, 8, "the cores that this process may use"),
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
    with pytest.raises(BadArgument, match=r"--threads|OMP_NUM_THREADS") as error:
        choose_threads(given, {"OMP_NUM_THREADS": by_user}, 8, None)
    assert "at least 1" in str(error.value)


@pytest.mark.parametrize(
    ("own", "file", "text", "quota"),
    [
        ("0::/job_7/task_0\n", "job_7/task_0/cpu.max", "250000 100000\n", 2.5),
        ("0::/job_7/task_0\n", "job_8/cpu.max", "100000 100000\n", None),  # of other processes
        ("0::/\n", "cpu.max", "max 100000\n", None),
        ("0::/docker/4fa6\n", "cpu.max", "150000 100000\n", 1.5),  # a container that sees its path on the host
        ("4:cpu,cpuacct:/job_7\n", "cpu.max", "150000 100000\n", None),  # version 1
    ],
)
def test_the_quota_is_that_of_the_own_control_group(
    tmp_path: Path, own: str, file: str, text: str, quota: float | None
):
    place = tmp_path / "sys/fs/cgroup" / file
    place.parent.mkdir(parents=True)
    place.write_text(text)
    (tmp_path / "proc/self").mkdir(parents=True)
    (tmp_path / "proc/self/cgroup").write_text(own)
    assert cpu_quota(tmp_path) == quota
