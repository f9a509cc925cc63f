"""Memory of one simulator with its pictures drawn, in a process of its own.

    OMP_NUM_THREADS=1 python benchmarks/simulator_memory.py libero_10:0 libero_10:3 cubes:0      SUITE:TASK ...

LIBERO's suites take the assets that `find_assets` finds. Prints MiB; nothing is asserted.
"""

from __future__ import annotations

import os
import resource
import subprocess
import sys

import numpy as np

from vla_attention.capture.environments.base import EnvironmentSettings
from vla_attention.capture.environments.suites import find_suite, make_environment


def measure(suite: str, task_id: int) -> float:
    """Return the highest resident memory of this process after a reset and ten waiting steps, in MiB."""
    environment = make_environment(find_suite(suite), task_id, EnvironmentSettings())
    environment.reset(0, 7)
    for _ in range(10):
        environment.step(np.array([0, 0, 0, 0, 0, 0, -1.0]), observe=True)
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


if __name__ == "__main__":
    os.environ.setdefault("MUJOCO_GL", "egl")
    if len(sys.argv) == 2:
        suite, _, task = sys.argv[1].partition(":")
        print(f"{suite} {task}: {measure(suite, int(task)):.0f} MiB")
    else:
        for one in sys.argv[1:]:
            subprocess.run([sys.executable, __file__, one], check=True)
