"""Policies whose attention is uniform by construction: recorded, and analysed, every lift is 1."""

from __future__ import annotations

import numpy as np
import polars as pl
import pytest
import torch

import vla_attention as va
from tests.kit.small_torch_variants import OneModulePolicy, TokenPolicy, one_module_layout, token_layout

TEXTS = ("pick the bowl", "pick up the red bowl")


@pytest.mark.parametrize("tokens", [4, 2])
def test_a_policy_that_generates_tokens(tmp_path, tokens):
    """Prompts differ in length, later queries see more keys, and with 2 tokens the last two are never generated."""
    policy = TokenPolicy()
    with torch.no_grad():
        for layer in policy.layers:
            layer.qkv.weight.zero_()
            layer.qkv.bias.zero_()
    layout = token_layout(stops_early=tokens < 4)
    given = {"layout": layout, "tokenizer": policy.tokenizer, "durable": False, "bits": 23}
    with va.record(tmp_path / "a.zarr", policy, **given) as run:
        for number, text in enumerate(TEXTS):
            with run.episode(task_id=number, episode_index=0, instruction=text) as episode:
                for step in range(2):
                    with episode.replan(env_step=step):
                        policy.act(torch.rand(3, 8, 8), text, tokens)
    opened = va.open(tmp_path / "a.zarr")
    groups = opened.analyze(grouping="instruction")["steps_groups"].filter(pl.col("keys") > 0)
    assert set(groups["group"]) == {"visual", "linguistic", "template", "action"}
    np.testing.assert_allclose(groups["lift"].to_numpy(), 1.0, rtol=1e-5)
    cells = opened.analyze()["steps"]
    np.testing.assert_allclose(cells["ratio"].to_numpy(), cells["uniform_ratio"].to_numpy(), rtol=1e-5)
    np.testing.assert_allclose(opened.words()["words_episodes"].filter(kind="word")["lift"].to_numpy(), 1.0, rtol=1e-5)


def test_sites_in_different_blocks(tmp_path):
    policy = OneModulePolicy()
    width = policy.expert.projections[0].in_features
    prefix, noise = torch.zeros(1, 5, width), torch.zeros(1, 3, width)
    with (
        va.record(tmp_path / "a.zarr", policy, layout=one_module_layout(), durable=False, contributions=False) as run,
        run.episode(task_id=0, episode_index=0, instruction="go") as episode,
        episode.replan(env_step=0),
    ):
        policy.act(prefix, noise)
    for site, blocks, keys in (("self", [0, 2], [5, 3]), ("cross", [1, 3], [5])):
        groups = va.open(tmp_path / "a.zarr").analyze(site=site)["steps_groups"].filter(pl.col("keys") > 0)
        assert groups["block"].unique().sort().to_list() == blocks
        assert groups["keys"].unique().to_list() == pytest.approx(sorted(keys))
