"""What of the memory is left: the least of what the machine, a control group and a SLURM job leave."""

from __future__ import annotations

from pathlib import Path

import pytest

from vla_attention.capture import machine
from vla_attention.capture.machine import memory_left, memory_limits

GB = 2**30


@pytest.fixture
def root(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A machine with 16 GB left, whose process takes 1 GB."""
    for name in ("SLURM_MEM_PER_NODE", "SLURM_MEM_PER_CPU", "SLURM_CPUS_ON_NODE"):
        monkeypatch.delenv(name, raising=False)
    write(tmp_path, "proc/meminfo", f"MemTotal: 99 kB\nMemAvailable:   {16 * GB // 1024} kB\n")
    write(tmp_path, "proc/self/status", f"VmRSS:\t {GB // 1024} kB\n")
    return tmp_path


def write(root: Path, name: str, text: str) -> None:
    path = root / name
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text, encoding="utf-8")


def left(root: Path) -> list[tuple[float, str]]:
    return [(limit.bytes / GB, limit.by) for limit in memory_limits(root)]


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        ({"SLURM_MEM_PER_NODE": "5120"}, 4),
        ({"SLURM_MEM_PER_CPU": "1024", "SLURM_CPUS_ON_NODE": "3"}, 2),
        ({"SLURM_MEM_PER_NODE": "0"}, None),
    ],
)
def test_a_slurm_job_has_what_it_asked_for(root, given, expected, monkeypatch):
    for name, value in given.items():
        monkeypatch.setenv(name, value)
    assert left(root)[1:] == ([] if expected is None else [(expected, "the SLURM job")])


def test_a_control_group_leaves_what_is_neither_taken_nor_given_back(root):
    write(root, "proc/self/cgroup", "0::/job_7\n")
    files = {"max": f"{8 * GB}\n", "current": f"{7 * GB}\n", "stat": f"anon 5\ninactive_file {2 * GB}\n"}
    for name, text in files.items():
        write(root, f"sys/fs/cgroup/job_7/memory.{name}", text)
    assert left(root)[1:] == [(3, "its control group")]
    write(root, "sys/fs/cgroup/job_7/memory.max", "max\n")
    assert left(root)[1:] == []


def test_the_least_counts(root, monkeypatch):
    monkeypatch.setenv("SLURM_MEM_PER_NODE", "5120")
    limits = memory_limits(root)
    monkeypatch.setattr(machine, "memory_limits", lambda: limits)
    assert memory_left() == 4 * GB
