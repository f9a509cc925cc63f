"""The trained policy that comes with the package: its size, its card, and that it reads and looks."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.kit.policy_inputs import make_observation
from vla_attention.capture.policies.pi.family import CUBES_POLICY, PiSettings
from vla_attention.capture.policies.pi.loading import build_pi_policy
from vla_attention.capture.policies.pi.policy import PiPolicy
from vla_attention.schemas.layout import Role


@pytest.fixture(scope="module")
def policy() -> PiPolicy:
    return build_pi_policy(PiSettings(), "cpu")


def test_stores_name_it_and_not_the_place_where_it_is_installed(policy: PiPolicy) -> None:
    identity = policy.identity()
    assert (identity.name, identity.checkpoint, identity.untrained) == (CUBES_POLICY, CUBES_POLICY, False)


def test_its_words_are_whole_tokens_and_its_state_has_a_token_per_number(policy: PiPolicy) -> None:
    observation = make_observation(0)
    given = policy.prepare(observation, "put the red cube on the green cube")
    pieces = given.prompt.pieces
    text = given.prompt.text
    words = [text[piece.start : piece.stop].strip() for piece in pieces]
    for word in ("put", "the", "red", "cube", "on", "green"):
        assert word in words
    assert (given.key_role["joint"] == Role.STATE).sum() == 8


def test_another_word_changes_what_it_does(policy: PiPolicy) -> None:
    observation = make_observation(0)
    red, again, blue = (
        policy.act(policy.prepare(observation, f"lift the {colour} cube"), 3) for colour in ("red", "red", "blue")
    )
    np.testing.assert_array_equal(red, again)
    assert not np.allclose(red, blue, atol=1e-3)
    black = replace(observation, images={name: np.zeros_like(image) for name, image in observation.images.items()})
    blind = policy.act(policy.prepare(black, "lift the red cube"), 3)
    assert not np.allclose(red, blind, atol=1e-3)
