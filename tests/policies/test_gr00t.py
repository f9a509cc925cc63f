"""GR00T N1.5 of LeRobot 0.4.4: the real policy and action head, on a stand-in for the vision-language model."""

from __future__ import annotations

import numpy as np
import pytest
import torch

pytest.importorskip("lerobot.policies.groot.groot_n1", reason="run by make test-policies, in .venv-lerobot")

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

PATCHES, CHUNK, HEADS, DIM = 4, 5, 4, 8
WORDS = len(INSTRUCTION.split())


@pytest.fixture(scope="module")
def case():
    policy, given = models.small_groot(), models.groot_observation()
    layout = va.layouts.gr00t(
        policy, given["eagle_input_ids"][0], cameras=models.CAMERAS, picture_size=4, prompt_tokens=WORDS + 2
    )
    return PolicyCase(policy, layout, models.chunk_of(policy), given)


def by_hand(case: PolicyCase) -> list[np.ndarray]:
    """Rows (denoise, head, query, key) of each block from its own projections."""
    blocks = case.policy._groot_model.action_head.model.transformer_blocks
    kept: list[dict[str, list[torch.Tensor]]] = [{"query": [], "key": []} for _ in blocks]
    handles = []
    for number, block in enumerate(blocks):
        for name, module in (("query", block.attn1.to_q), ("key", block.attn1.to_k)):
            handles.append(
                module.register_forward_hook(
                    lambda _module, _inputs, output, kept=kept[number][name]: kept.append(output[0])
                )
            )
    case.call(case.observation)
    for handle in handles:
        handle.remove()

    def heads(projected):
        return projected.reshape(len(projected), HEADS, DIM).transpose(0, 1)

    return [
        np.stack(
            [
                softmax_rows(heads(query)[:, -CHUNK:], heads(key), DIM**-0.5)
                for query, key in zip(block["query"], block["key"], strict=True)
            ]
        )
        for block in kept
    ]


def test_rows_are_those_of_the_blocks_own_queries_and_keys(case, tmp_path):
    store = record(case, tmp_path)
    rows = by_hand(case)
    cross = np.stack([rows[0], rows[2]])
    # The layout's prompt may be two tokens longer than that of this call.
    check_rows(store, "cross", np.insert(cross, [cross.shape[-1]] * 2, 0.0, axis=-1))
    check_rows(store, "self", np.stack([rows[1], rows[3]]))
    assert {site.name: site.layers for site in store.attributes.sites} == {"cross": (0, 2), "self": (1, 3)}


def test_keys_have_the_roles_of_the_chat_template(case, tmp_path):
    store = record(case, tmp_path)
    picture = ["image"] * PATCHES
    words = ["instruction"] * WORDS + ["absent"] * 2
    assert roles_of(store, "cross") == ["template", *picture, "template", *picture, *words]
    assert roles_of(store, "self") == ["state", "learned", "learned", *["action"] * CHUNK]
    pieces = store.episodes[0].attributes.prompts[0].pieces
    assert [piece.text.strip() for piece in pieces[-WORDS:]] == INSTRUCTION.split()


@pytest.mark.parametrize("site", ["cross", "self"])
def test_contributions_are_what_the_blocks_add(case, tmp_path, site):
    blocks = case.policy._groot_model.action_head.model.transformer_blocks

    def stream(block):
        return (blocks[block].norm1, "given"), (blocks[block].norm3, "given")

    projection = "_groot_model.action_head.model.transformer_blocks.{block}.attn1.to_out.0"
    check_contributions(case, record(case, tmp_path), site, stream, projection)


def test_the_state_reaches_its_key(case):
    # Cross-attention mixes no action tokens with one another: those of the first self-attention are still their own.
    check_change(case, "span:state", {**case.observation, "state": case.observation["state"] + 1}, site="self")


def test_a_knockout_takes_the_keys_mass_away(case, tmp_path):
    rows = rows_of(record(case, tmp_path, replans=1, interventions=va.knockout("camera:wrist")), "cross")
    assert not rows[..., 2 + PATCHES : 2 + 2 * PATCHES].any()
    np.testing.assert_allclose(rows.sum(axis=-1), 1, atol=1e-5)


def test_the_analysis_answers_at_both_sites(case, tmp_path):
    record(case, tmp_path)
    check_analysis(tmp_path, ["cross"])
    check_analysis(tmp_path, ["self"], ratios=False)


def test_ids_without_a_picture_for_each_camera_are_refused(case):
    with pytest.raises(ValueError, match="hold 2 runs of placeholders"):
        va.layouts.gr00t(case.policy, case.observation["eagle_input_ids"][0], cameras=["top"])


def test_queries_of_zero_have_lift_1(case, tmp_path):
    check_uniform_attention(case, tmp_path)
