"""Fixtures of the pi tests: the golden cases, and small policies built once."""

from __future__ import annotations

import pytest

from tests.kit.pi_golden import GOLDEN, LARGE_GOLDEN, GoldenCase, load_case
from tests.kit.policy_inputs import make_observation
from vla_attention.capture.environments.base import Observation
from vla_attention.capture.policies.pi.embedded import dummy_policy, embedded_policy


@pytest.fixture(scope="session", params=["pi05_batch2", "pi0_batch2", "pi05_full_layout"])
def golden_case(request) -> GoldenCase:
    folder = GOLDEN / request.param
    if request.param == "pi05_full_layout":
        folder = LARGE_GOLDEN / request.param
        if not folder.is_dir():
            pytest.skip(
                "the golden case with the full token layout is not in the repository, and not beside this checkout"
            )
    return load_case(folder)


@pytest.fixture(scope="session")
def pi05_case() -> GoldenCase:
    return load_case(GOLDEN / "pi05_batch2")


@pytest.fixture(scope="session")
def embedded():
    return embedded_policy()


@pytest.fixture(scope="session")
def dummy():
    return dummy_policy()


@pytest.fixture
def observation() -> Observation:
    """A scene of coloured rectangles, and a hand pointing down."""
    return make_observation(0)
