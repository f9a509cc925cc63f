"""SmolVLA of LeRobot: the real class with small random weights."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch

pytest.importorskip("lerobot", reason="run by make test-policies, in .venv-lerobot")

import vla_attention as va
from tests.policies import lerobot_models as models
from tests.policies.policy_checks import (
    PolicyCase,
    check_analysis,
    check_change,
    check_contributions,
    check_rows,
    check_uniform_attention,
    record,
    roles_of,
    rows_of,
    softmax_rows,
)
from tests.policies.word_tokenizer import INSTRUCTION
from vla_attention.capture.torch_policies.layouts.layout_building import NotThisPolicy
from vla_attention.schemas.stores.reader import open_store

PATCHES, CHUNK, STEPS, HEADS, DIM = 16, 5, 3, 3, 16
WORDS = len(INSTRUCTION.split())


@pytest.fixture(scope="module")
def policy(tmp_path_factory):
    return models.small_smolvla(tmp_path_factory.mktemp("vlm"))


def case_of(policy: Any, padding: int = 2, **changes: Any) -> PolicyCase:
    given = models.observation(48, 64, padding=padding, **changes)
    return PolicyCase(
        policy,
        va.layouts.smolvla(policy),
        models.chunk_of(policy),
        given,
        models.frames_of(given),
        given["observation.state"],
    )


@pytest.fixture(scope="module")
def case(policy):
    return case_of(policy)


def by_hand(case: PolicyCase) -> dict[str, np.ndarray]:
    """Rows (layer, denoise, head, query, key) of both kinds of blocks from what the policy's attention is given."""
    model = case.policy.model.vlm_with_expert
    kept: list[np.ndarray] = []
    own = model.eager_attention_forward

    def attention(mask, batch, dim, query, key, value):
        if query.shape[1] == CHUNK:
            heads = key.repeat_interleave(query.shape[2] // key.shape[2], dim=2)
            kept.append(softmax_rows(query[0].transpose(0, 1), heads[0].transpose(0, 1), DIM**-0.5, mask[0]))
        return own(mask, batch, dim, query, key, value)

    model.eager_attention_forward = attention
    try:
        case.call(case.observation)
    finally:
        del model.eager_attention_forward
    blocks = [np.stack(kept[block::4]) for block in range(4)]
    return {"self": np.stack(blocks[0::2]), "cross": np.stack(blocks[1::2])}


def with_absent(rows: np.ndarray, padding: int) -> np.ndarray:
    """Rows with zeros for the keys of the layout's longest prompt (12 tokens) that the call does not have."""
    end = 2 * (PATCHES + 3) + WORDS + padding
    return np.insert(rows, [end] * (12 - WORDS - padding), 0.0, axis=-1)


def test_rows_are_those_of_the_policy_s_own_queries_and_keys(case, tmp_path):
    store = record(case, tmp_path)
    for site, rows in by_hand(case).items():
        check_rows(store, site, with_absent(rows, 2))
    layers = {site.name: site.layers for site in store.attributes.sites}
    assert layers == {"self": (0, 2), "cross": (1, 3)}


def test_keys_have_the_roles_of_pictures_separators_words_and_padding(case, tmp_path):
    store = record(case, tmp_path)
    # Pictures of 48 x 64 have black above: the first row of 4 x 4 patches.
    camera = ["template"] * 2 + ["border"] * 4 + ["image"] * (PATCHES - 4) + ["template"]
    prompt = ["instruction"] * WORDS + ["padding"] * 2 + ["absent"] * 4
    assert roles_of(store, "cross") == [*camera, *camera, *prompt, "state"]
    assert roles_of(store, "self") == [*camera, *camera, *prompt, "state", *["action"] * CHUNK]


def test_an_action_token_of_self_sees_those_before_it_only(case, tmp_path):
    rows = rows_of(record(case, tmp_path), "self")[..., -CHUNK:]
    later = np.triu(np.ones((CHUNK, CHUNK), dtype=bool), 1)
    assert not rows[..., later].any()
    assert (rows[..., ~later] > 0).all()


@pytest.mark.parametrize("camera", models.CAMERAS)
def test_a_camera_s_picture_reaches_its_patches_and_no_others(case, camera):
    name = f"observation.images.{camera}"
    check_change(case, f"camera:{camera}", {**case.observation, name: 1 - case.observation[name]})


def test_the_words_the_state_and_the_noise_reach_their_keys(case):
    tokens = case.observation["observation.language.tokens"].clone()
    tokens[:, INSTRUCTION.split().index("bowl")] += 20
    check_change(case, "word:bowl", {**case.observation, "observation.language.tokens": tokens})
    check_change(case, "span:state", {**case.observation, "observation.state": torch.zeros(1, 6)})
    short = case_of(case.policy, padding=6)
    ids = short.observation["observation.language.tokens"] + 20
    check_change(short, "span:prompt", {**short.observation, "observation.language.tokens": ids})
    noise = models.chunk_of(case.policy, seed=5)
    chosen = PolicyCase(
        case.policy, case.layout, lambda batch: (noise if "noise" in batch else case.call)(batch), case.observation
    )
    check_change(chosen, "span:actions", {**case.observation, "noise": torch.zeros(1)})


def test_select_action_answers_from_its_queue_in_between(policy, tmp_path):
    case = case_of(policy)
    policy.reset()
    with (
        va.record(tmp_path / "run.zarr", policy, layout=case.layout, durable=False) as run,
        run.episode(task_id=0, episode_index=0, instruction=INSTRUCTION) as episode,
    ):
        for step in range(2 * CHUNK):
            with episode.replan(env_step=step), torch.inference_mode():
                policy.select_action(dict(case.observation))
    assert (episode.num_replans, episode.num_dropped) == (2, 2 * CHUNK - 2)
    assert list(open_store(tmp_path / "run.zarr").episodes[0].read("env_step")) == [0, CHUNK]


@pytest.mark.parametrize("site", ["self", "cross"])
def test_contributions_are_what_the_expert_s_layers_add(case, tmp_path, site):
    layers = case.policy.model.vlm_with_expert.lm_expert.layers

    def stream(block):
        return (layers[block].input_layernorm, "given"), (layers[block].post_attention_layernorm, "given")

    check_contributions(case, record(case, tmp_path), site, stream)


@pytest.mark.parametrize("what", ["word:bowl", "camera:wrist"])
def test_a_knockout_takes_the_keys_mass_away(case, tmp_path, what):
    store = record(case, tmp_path, replans=1, interventions=va.knockout(what))
    start = 2 * (PATCHES + 3)
    keys = [start + INSTRUCTION.split().index("bowl")] if what == "word:bowl" else range(start - 1 - PATCHES, start - 1)
    for site in ("self", "cross"):
        rows = rows_of(store, site)
        assert not rows[..., list(keys)].any()
        np.testing.assert_allclose(rows.sum(axis=-1), 1, atol=1e-5)


def test_an_empty_camera_is_masked(tmp_path):
    policy = models.small_smolvla(tmp_path, empty_cameras=1)
    case = case_of(policy)
    assert [camera.name for camera in case.layout.cameras] == ["top", "wrist", "empty_camera_0"]
    roles = roles_of(record(case, tmp_path), "cross")
    assert roles[2 * (PATCHES + 3) : 3 * (PATCHES + 3)] == ["template"] * 2 + ["masked_image"] * PATCHES + ["template"]


def test_blocks_that_are_all_self_and_an_expert_of_half_the_blocks(tmp_path):
    plain = models.small_smolvla(tmp_path / "a", attention_mode="self_attn", add_image_special_tokens=False)
    store = record(case_of(plain), tmp_path / "a")
    assert [site.name for site in store.attributes.sites] == ["self"]
    half = models.small_smolvla(tmp_path / "b", num_expert_layers=2, self_attn_every_n_layers=4)
    store = record(case_of(half), tmp_path / "b")
    assert {site.name: site.layers for site in store.attributes.sites} == {"self": (0,), "cross": (1,)}


def test_the_analysis_answers_at_both_sites(case, tmp_path):
    record(case, tmp_path)
    check_analysis(tmp_path, ["self", "cross"])


def test_what_the_layout_cannot_cover_is_refused(tmp_path):
    same = models.small_smolvla(tmp_path, chunk_size=44, n_action_steps=5)
    with pytest.raises(NotThisPolicy, match="may be as long as its chunk of 44 actions"):
        va.layouts.smolvla(same)
    padded = models.small_smolvla(tmp_path, prefix_length=60)
    with pytest.raises(NotThisPolicy, match="pad_language_to='max_length'"):
        va.layouts.smolvla(padded)
    with pytest.raises(NotThisPolicy, match="for SmolVLAPolicy, but a Linear was given"):
        va.layouts.smolvla(torch.nn.Linear(2, 2))


def test_queries_of_zero_have_lift_1(case, tmp_path):
    check_uniform_attention(case, tmp_path)
