"""All 130 tasks of LIBERO with its original assets: built, set to a stored state, waited, both pictures drawn.

`make test-libero` runs it; half an hour, 3 GB of memory.
"""

from __future__ import annotations

import numpy as np
import pytest

from vla_attention.capture.environments.base import EnvironmentSettings
from vla_attention.capture.environments.libero_assets import compare_with_originals, find_assets
from vla_attention.capture.environments.suites import find_suite, make_environment
from vla_attention.schemas.errors import UserError

pytestmark = [pytest.mark.thorough, pytest.mark.simulator]
WAIT = np.array([0, 0, 0, 0, 0, 0, -1.0])
SUITES = ("libero_spatial", "libero_object", "libero_goal", "libero_10", "libero_90")


@pytest.fixture(scope="module", autouse=True)
def original_assets():
    try:
        _, *faults = compare_with_originals(find_assets(None))
    except UserError as error:
        pytest.skip(f"needs LIBERO's original assets: {error}")
    if any(faults):
        pytest.skip("needs LIBERO's original assets, and finds a copy that differs")


@pytest.mark.parametrize(
    ("suite", "first"), [(suite, first) for suite in SUITES for first in range(0, find_suite(suite).num_tasks, 10)]
)
def test_every_task_loads_and_draws(suite, first):
    for task_id in range(first, first + 10):
        environment = make_environment(find_suite(suite), task_id, EnvironmentSettings())
        try:
            environment.reset(0, 7)
            waited = [environment.step(WAIT, observe=step == 9) for step in range(10)]
            observation = waited[-1].observation
            assert observation is not None
            assert {picture.shape for picture in observation.images.values()} == {(256, 256, 3)}
            assert all(len(np.unique(picture)) > 50 for picture in observation.images.values()), (suite, task_id)
        finally:
            environment.close()
