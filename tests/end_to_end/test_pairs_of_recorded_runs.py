"""Which episodes of two runs of `va.record` are pairs, by what their loops said and showed of how they begin."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import vla_attention as va
from tests.kit.questions import question_about
from tests.kit.small_torch_policy import SmallPolicy, given, small_layout
from vla_attention.analyze.core.compared import RunValues, compared
from vla_attention.analyze.core.runs import Run

PICTURES = np.random.default_rng(0).integers(0, 250, (3, 8, 8, 3)).astype(np.uint8)
EPISODES = 3


def recorded(
    path: Path, frames: np.ndarray | None, states: list[Any] | None = None, noise: list[int] | None = None
) -> Path:
    policy = SmallPolicy()
    with va.record(path, policy, layout=small_layout(), tokenizer=policy.tokenizer, contributions=False) as run:
        for index in range(EPISODES):
            about: dict[str, Any] = {"seed": None if noise is None else noise[index]}
            about |= {} if states is None else {"initial_state": states[index]}
            with run.episode(task_id=0, episode_index=index, instruction="pick the bowl", **about) as episode:
                of_call = {} if frames is None else {"frames": {"front": frames[index]}}
                with episode.replan(env_step=0, **of_call) as replan:
                    replan.actions = policy.act(**given())
    return path


@pytest.fixture(scope="module")
def base(tmp_path_factory) -> Path:
    return recorded(tmp_path_factory.mktemp("base") / "a.zarr", PICTURES)


def pairs_with(first: Path, other: Path) -> tuple[list[tuple[int, bool, float | None]], int]:
    """(episode, whether its state is known, how far pictures are apart) of each pair; and how many were refuted."""
    values = [RunValues.of(Run(path.stem, question_about(path)), ignore_seed=False) for path in (first, other)]
    found = compared(*values, values[0].run.question.sampling)
    return found.pairs.select("episode_first", "stated", "pictures_apart").rows(), found.refuted.height


def test_first_pictures_refute_what_is_paired_by_number(base, tmp_path):
    pictures = PICTURES.copy()
    pictures[0] += 1  # as another driver draws
    pictures[1] = PICTURES[2]
    apart = np.abs(PICTURES[1].astype(float) - PICTURES[2]).mean()
    assert apart > 2
    found, refuted = pairs_with(base, recorded(tmp_path / "b.zarr", pictures))
    assert found == [(0, False, 1.0), (2, False, 0.0)]
    assert refuted == 1


def test_without_pictures_the_number_is_all_that_pairs(base, tmp_path):
    other = recorded(tmp_path / "b.zarr", None)
    assert pairs_with(base, other) == ([(index, False, None) for index in range(EPISODES)], 0)
    first = va.open(base).compare(other).about
    assert [line for line in first if "Paired by number only" in line]


def test_states_pair_episodes_in_any_order_and_other_noise_parts_them(tmp_path):
    states = [np.arange(4.0) + index for index in range(EPISODES)]
    first = recorded(tmp_path / "a.zarr", PICTURES, states, [7, 8, 9])
    turned = recorded(tmp_path / "b.zarr", PICTURES[::-1], states[::-1], [9, 8, 1])
    assert pairs_with(first, turned) == ([(1, True, None), (2, True, None)], 0)


def test_a_seed_that_is_not_known_fits_one_episode_alone(tmp_path):
    first = recorded(tmp_path / "a.zarr", PICTURES, ["it"] * EPISODES, [7, 8, 9])
    other = recorded(tmp_path / "b.zarr", PICTURES, ["it"] * EPISODES)
    found, _ = pairs_with(first, other)
    assert len(found) == len({one for one, *_ in found}) == 1


def test_runs_without_outcomes_and_pairs_are_compared(tmp_path, base):
    """Outcomes of `va.record` may all be unknown: what does better is not known then, and the rest is."""
    other = recorded(tmp_path / "b.zarr", 255 - PICTURES)
    found = va.open(base).compare(other)
    assert [line for line in found.about if "Not paired" in line]
    assert next(one for one in found.findings if one.asks == "Which does better?").numbers == {}


def test_an_initial_state_that_is_none_is_refused(tmp_path):
    with pytest.raises(va.UserError, match="initial state"):
        recorded(tmp_path / "a.zarr", None, [object()])
