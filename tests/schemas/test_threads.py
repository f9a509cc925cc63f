"""The number of threads from faked machines, and that it is in place before a library reads it."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from vla_attention.schemas import threads
from vla_attention.schemas.errors import BadArgument
from vla_attention.schemas.threads import available_cores, choose_threads, count_cores, cpu_quota, use_threads

V1_MOUNT = "32 31 0:29 {tree} /sys/fs/cgroup/cpu,cpuacct rw shared:9 - cgroup cgroup rw,cpu,cpuacct\n"
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


def test_no_control_groups_are_no_limit(tmp_path):
    assert cpu_quota(tmp_path) is None
    plain = machine(
        tmp_path, "0::/user.slice\n", V2_MOUNT.format(tree="/"), {"sys/fs/cgroup/user.slice/cpu.max": "max 100000\n"}
    )
    assert cpu_quota(plain) is None


def test_the_smallest_quota_on_the_way_up_counts(tmp_path):
    files = {
        "sys/fs/cgroup/job_7/cpu.max": "250000 100000\n",
        "sys/fs/cgroup/job_7/step_0/cpu.max": "max 100000\n",
        "sys/fs/cgroup/job_7/step_0/task_0/cpu.max": "400000 100000\n",
        "sys/fs/cgroup/job_8/cpu.max": "100000 100000\n",  # of other processes
    }
    root = machine(tmp_path, "0::/job_7/step_0/task_0\n", V2_MOUNT.format(tree="/"), files)
    assert cpu_quota(root) == 2.5


def test_version_1_and_a_group_that_is_the_mount_of_its_container(tmp_path):
    own = "9:name=systemd:/docker/abc\n4:cpu,cpuacct:/docker/abc\n3:cpuset:/docker/abc\n0::/\n"
    files = {
        "sys/fs/cgroup/cpu,cpuacct/cpu.cfs_quota_us": "150000\n",
        "sys/fs/cgroup/cpu,cpuacct/cpu.cfs_period_us": "100000\n",
    }
    root = machine(tmp_path, own, V1_MOUNT.format(tree="/docker/abc") + V2_MOUNT.format(tree="/"), files)
    assert cpu_quota(root) == 1.5
    (root / "sys/fs/cgroup/cpu,cpuacct/cpu.cfs_quota_us").write_text("-1\n")
    assert cpu_quota(root) is None


def test_two_processors_of_one_core_count_once(tmp_path):
    for number, siblings in enumerate(("0,2", "1,3", "0,2", "1,3")):
        file = tmp_path / f"sys/devices/system/cpu/cpu{number}/topology/thread_siblings_list"
        file.parent.mkdir(parents=True)
        file.write_text(f"{siblings}\n")
    assert count_cores({0, 1, 2, 3}, tmp_path) == 2
    assert count_cores({0, 2}, tmp_path) == 1
    assert count_cores({4, 5, 6}, tmp_path) == 3, "processors of which nothing is stated"


#: A finder that is asked for every module: what the environment says at the moment when one of them is first imported.
WATCH = """
import json, os, sys
class Watch:
    def find_spec(self, name, path=None, target=None):
        if name in ("torch", "numpy", "polars") and name not in seen:
            seen[name] = {key: os.environ.get(key) for key in KEYS}
seen, KEYS = {}, ("OMP_NUM_THREADS", "OMP_WAIT_POLICY", "GOMP_SPINCOUNT", "OPENBLAS_NUM_THREADS", "POLARS_MAX_THREADS")
sys.meta_path.insert(0, Watch())
"""


def run_watched(code: str, **environment: str) -> dict[str, dict[str, str]]:
    """What a process of its own saw at the first import of each library; the user has set nothing else."""
    names = ("OMP_", "GOMP_", "KMP_", "MKL_", "OPENBLAS_", "POLARS_", "SLURM_")
    clean = {name: value for name, value in os.environ.items() if not name.startswith(names)}
    done = subprocess.run(
        [sys.executable, "-c", f"{WATCH}{code}\nprint(json.dumps(seen))"],
        env={**clean, **environment},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    seen: dict[str, dict[str, str]] = json.loads(done.stdout.splitlines()[-1])
    return seen


def test_capture_sets_them_before_torch_is_loaded(tmp_path):
    code = f"""
from vla_attention.capture.__main__ import main
main(["pi", "--threads", "3", "--output", {str(tmp_path / "a.zarr")!r}, "--device", "cpu", "--layers", "99"])
import torch
assert torch.get_num_threads() == 3, torch.get_num_threads()
"""
    seen = run_watched(code)
    wanted = {"OMP_NUM_THREADS": "3", "OMP_WAIT_POLICY": "PASSIVE", "GOMP_SPINCOUNT": "0", "OPENBLAS_NUM_THREADS": "3"}
    assert wanted.items() <= seen["torch"].items()
    assert wanted.items() <= seen["numpy"].items()


def test_analysis_sets_them_before_numpy_and_polars_are_loaded(tmp_path):
    code = f"""
from vla_attention.analyze.__main__ import main
assert main([{str(tmp_path / "absent.zarr")!r}]) == 2
import numpy, polars
assert polars.thread_pool_size() == 2
"""
    seen = run_watched(code, OMP_NUM_THREADS="2", OMP_WAIT_POLICY="ACTIVE")
    for name in ("numpy", "polars"):
        assert seen[name] == {
            "OMP_NUM_THREADS": "2",
            "OMP_WAIT_POLICY": "ACTIVE",  # the user's choice
            "GOMP_SPINCOUNT": None,
            "OPENBLAS_NUM_THREADS": "1",
            "POLARS_MAX_THREADS": "2",
        }


def test_a_library_that_the_user_limited_keeps_its_number_unless_threads_is_given(monkeypatch):
    monkeypatch.setattr(os, "environ", {"POLARS_MAX_THREADS": "2", "OMP_NUM_THREADS": "6"})
    use_threads()
    assert (os.environ["POLARS_MAX_THREADS"], os.environ["MKL_NUM_THREADS"]) == ("2", "6")
    use_threads(4)
    assert {os.environ[name] for name in ("OMP_NUM_THREADS", "POLARS_MAX_THREADS", "MKL_NUM_THREADS")} == {"4"}


def test_available_cores_are_not_what_the_user_gives_to_the_policy(monkeypatch):
    for name in ("SLURM_CPUS_PER_TASK", "SLURM_CPUS_ON_NODE"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("OMP_NUM_THREADS", "1")
    monkeypatch.setattr(threads, "_cores", lambda: 12)
    monkeypatch.setattr(threads, "cpu_quota", lambda: None)
    assert available_cores() == 12
    monkeypatch.setenv("SLURM_CPUS_PER_TASK", "3")
    assert available_cores() == 3
