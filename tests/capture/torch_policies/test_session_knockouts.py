"""Knockouts of `va.record` against a policy whose masks were changed by hand, and what they refuse."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import nn

from tests.kit.small_torch_policy import HORIZON, SmallPolicy, given, small_layout
from tests.kit.small_torch_variants import TokenPolicy, token_layout
from vla_attention.capture.__main__ import main as vla_capture
from vla_attention.capture.interventions.factors import QueryWithoutKeys
from vla_attention.capture.torch_policies.record import record
from vla_attention.schemas.errors import BadArgument
from vla_attention.schemas.groupings.resolve import EmptyGroup
from vla_attention.schemas.groupings.selectors import SelectorError
from vla_attention.schemas.interventions import (
    AttentionScale,
    Interventions,
    KeyKnockout,
    knockout,
)
from vla_attention.schemas.stores.reader import open_store
from vla_attention.schemas.stores.store_format import RunMismatch
from vla_attention.schemas.stores.verify import verify_store

BOWL = 7  # the key of "bowl" in the prompt "<bos> pick the bowl"


def act_recorded(path, policy, **changes):
    changes = {
        "layout": small_layout(),
        "tokenizer": policy.tokenizer,
        "denoise_steps": "all",
        "durable": False,
    } | changes
    with (
        record(path / "a.zarr", policy, **changes) as run,
        run.episode(task_id=0, episode_index=0, instruction="pick the bowl") as episode,
        episode.replan(env_step=0) as replan,
    ):
        replan.actions = policy.act(**given())
    store = open_store(path / "a.zarr")
    assert verify_store(store) == []
    return store, replan.actions


def act_changed(policy, monkeypatch, bias, layers=(0, 1, 2), steps=(0, 1, 2, 3)):
    """The actions where `bias` (head, query, key) is added to the logits of the denoise steps' calls."""
    attend, calls = nn.functional.scaled_dot_product_attention, [0]

    def changed(q, k, v, attn_mask):
        if q.shape[2] != HORIZON:
            return attend(q, k, v, attn_mask=attn_mask)
        layer, step = calls[0] % 3, calls[0] // 3
        calls[0] += 1
        logits = torch.zeros(attn_mask.shape).masked_fill(~attn_mask, -torch.inf)
        return attend(q, k, v, attn_mask=logits + bias if layer in layers and step in steps else logits)

    with monkeypatch.context() as patch:
        patch.setattr(nn.functional, "scaled_dot_product_attention", changed)
        return policy.act(**given())


def test_a_word_that_is_not_read(tmp_path, monkeypatch):
    policy = SmallPolicy()
    store, actions = act_recorded(tmp_path, policy, interventions=knockout("word:bowl", name="without_bowl"))
    bias = torch.zeros(2, HORIZON, 14)
    bias[..., BOWL] = -torch.inf
    torch.testing.assert_close(actions, act_changed(policy, monkeypatch, bias), rtol=0, atol=1e-6)
    assert not torch.allclose(actions, policy.act(**given()), atol=1e-4)
    assert (store.episodes[0].read("joint/rows")[..., BOWL] == 0).all()
    assert store.attributes.interventions == Interventions("without_bowl", keys=(KeyKnockout("word:bowl"),))


def test_layers_heads_steps_and_weight(tmp_path, monkeypatch):
    policy = SmallPolicy()
    changed = knockout("word:bowl", "role:state", layers=[1], heads=[0], denoise_steps=[2, 0], weight=0.25)
    store, actions = act_recorded(tmp_path, policy, interventions=changed)
    bias = torch.zeros(2, HORIZON, 14)
    bias[0, :, [BOWL, 10]] = float(np.log(0.75))
    expected = act_changed(policy, monkeypatch, bias, layers=(1,), steps=(0, 2))
    torch.testing.assert_close(actions, expected, rtol=0, atol=1e-6)
    assert (store.episodes[0].read("joint/rows")[..., BOWL] > 0).all()


def test_keeping_one_group_and_factors_of_attention(tmp_path, monkeypatch):
    policy = SmallPolicy()
    _, actions = act_recorded(tmp_path / "keep", policy, interventions=knockout("camera:front", keep=True))
    bias = torch.full((2, HORIZON, 14), -torch.inf)
    bias[..., :4] = 0
    bias[..., 11:] = 0
    torch.testing.assert_close(actions, act_changed(policy, monkeypatch, bias), rtol=0, atol=1e-6)
    scaled = Interventions(attention=(AttentionScale("camera:front", 3.0),))
    _, actions = act_recorded(tmp_path / "scale", policy, interventions=scaled)
    bias = torch.zeros(2, HORIZON, 14)
    bias[..., :4] = float(np.log(3))
    torch.testing.assert_close(actions, act_changed(policy, monkeypatch, bias), rtol=0, atol=1e-6)


def test_a_knockout_is_a_part_of_the_runs_configuration(tmp_path, capsys):
    policy = SmallPolicy()
    act_recorded(tmp_path, policy, interventions=knockout("word:bowl"))
    with pytest.raises(RunMismatch, match="interventions"):
        act_recorded(tmp_path, policy, resume=True)
    assert vla_capture(["rerun", str(tmp_path / "a.zarr")]) == 2
    assert "va.record" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("changes", "error", "named"),
    [
        (knockout("word:cup"), SelectorError, "cup"),
        (knockout("word:bowl", layers=[3]), BadArgument, "layer 3 .*'word:bowl'"),
        (knockout("role:value"), EmptyGroup, "replan 0"),
        (knockout("* - role:padding"), QueryWithoutKeys, ""),
    ],
)
def test_what_cannot_be_done_is_refused_by_name(tmp_path, changes, error, named):
    with pytest.raises(error, match=named):
        act_recorded(tmp_path, SmallPolicy(), interventions=changes)


def test_a_word_in_a_prompt_of_changing_length(tmp_path):
    policy = TokenPolicy()
    picture = torch.rand(3, 8, 8, generator=torch.Generator().manual_seed(0))
    with record(
        tmp_path / "a.zarr",
        policy,
        layout=token_layout(),
        tokenizer=policy.tokenizer,
        interventions=knockout("word:bowl"),
        durable=False,
    ) as run:
        for number, text in enumerate(("pick the bowl", "pick up the red bowl")):
            with run.episode(task_id=number, episode_index=0, instruction=text) as episode, episode.replan(env_step=0):
                policy.act(picture, text)
    store = open_store(tmp_path / "a.zarr")
    assert verify_store(store) == []
    for episode, key in zip(store.episodes, (7, 9), strict=True):
        rows = episode.read("joint/rows")
        assert (rows[..., key] == 0).all()
        assert (rows[..., key - 1] > 0).all()


@pytest.mark.parametrize("group", ["word:plate", "word:plate | word:red"])
def test_a_word_that_the_instruction_lacks_changes_nothing_where_that_is_allowed(tmp_path, group):
    policy = SmallPolicy()
    with pytest.raises(SelectorError):
        act_recorded(tmp_path, policy, interventions=knockout(group))
    (tmp_path / "allowed").mkdir()
    _, actions = act_recorded(tmp_path / "allowed", policy, interventions=knockout(group), allow_empty=True)
    assert torch.equal(actions, policy.act(**given()))
