"""An analysis by dask workers that SLURM starts, one of which is killed; runs with `make test-slurm` where it can."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from pathlib import Path

import pytest

from tests.kit.stores import write_store
from vla_attention.analyze.__main__ import main

ROOT = Path(__file__).parents[2]
#: Seconds after which a job that has not started will not start.
_PATIENCE = 300

pytestmark = pytest.mark.skipif(os.environ.get("VLA_TEST_SLURM") != "1", reason="make test-slurm runs it")


@pytest.fixture
def cluster(tmp_path):
    jobqueue = pytest.importorskip("dask_jobqueue")
    with jobqueue.SLURMCluster(
        cores=1,
        processes=1,
        memory="1GB",
        walltime="00:20:00",
        python=sys.executable,
        job_script_prologue=[f"export PYTHONPATH={ROOT} OMP_NUM_THREADS=1"],
        log_directory=str(tmp_path / "logs"),
        scheduler_options={"dashboard_address": ":0"},
    ) as cluster:
        cluster.adapt(minimum=2, maximum=2)
        yield cluster


def jobs(cluster) -> list[str]:
    return [worker.job_id for worker in cluster.workers.values() if getattr(worker, "job_id", None)]


def test_a_job_that_is_killed_in_the_middle_changes_nothing(cluster, tmp_path):
    store = write_store(tmp_path / "a.zarr", tasks=tuple(range(10)), episodes=10)
    command = ["words", str(store), "--no-plots", "--output"]
    assert main([*command, str(tmp_path / "a")]) == 0
    deadline = time.monotonic() + _PATIENCE
    while len(cluster.scheduler_info["workers"]) < 2:
        assert time.monotonic() < deadline, "SLURM did not start two workers"
        time.sleep(1)
    program = [sys.executable, "-m", "vla_attention.analyze", *command, str(tmp_path / "b")]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    running = subprocess.Popen([*program, "--scheduler", cluster.scheduler_address], env=environment)
    first, *others = jobs(cluster)
    subprocess.run(["scancel", "--signal=KILL", first], check=True)
    assert running.wait() == 0
    assert others
    for file in sorted((tmp_path / "a").glob("*.parquet")):
        assert file.read_bytes() == (tmp_path / "b" / file.name).read_bytes(), file
