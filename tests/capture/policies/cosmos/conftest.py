"""Fixtures of the Cosmos tests: policies of test size, built once."""

from __future__ import annotations

import pytest
import torch

from tests.kit.cosmos_checkpoint import write_dummy_folder
from tests.kit.cosmos_helpers import INSTRUCTION, OTHER_INSTRUCTION
from tests.kit.policy_inputs import make_observation
from vla_attention.capture.policies.cosmos.embedded import DUMMY_CONFIG, random_policy


@pytest.fixture(scope="session")
def dummy():
    pytest.importorskip("diffusers")
    return random_policy("untrained-tiny", DUMMY_CONFIG)


@pytest.fixture(scope="session")
def prepared(dummy):
    return dummy.prepare(make_observation(0), INSTRUCTION)


@pytest.fixture(scope="session")
def dummy_folder(tmp_path_factory):
    """A checkpoint folder in float32; tests that change it copy it."""
    pytest.importorskip("diffusers")
    folder = tmp_path_factory.mktemp("cosmos") / "checkpoint"
    return write_dummy_folder(folder, DUMMY_CONFIG, [INSTRUCTION, OTHER_INSTRUCTION], dtype=torch.float32)
