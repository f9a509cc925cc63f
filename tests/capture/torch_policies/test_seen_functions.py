"""Attention functions under their names and otherwise: both ways see the same calls, and leave nothing behind."""

from __future__ import annotations

import pytest
import torch
from torch.nn import functional
from torch.nn.functional import scaled_dot_product_attention as imported_by_name

import vla_attention as va
from tests.capture.torch_policies.test_odd_policies import OddPolicy, layout
from vla_attention.capture.torch_policies import seen_functions
from vla_attention.schemas.stores.reader import open_store


@pytest.mark.parametrize(("function", "ways"), [(None, [True, False] * 2), (imported_by_name, [True] * 4)])
def test_a_session_looks_at_every_function_until_it_knows_better(tmp_path, monkeypatch, function, ways):
    """At the first policy call of each episode, and always where a policy calls functions by other names."""
    asked: list[bool] = []
    own = seen_functions.SeenFunctions.__init__

    def noted(self, block, *, every_function):
        asked.append(every_function)
        own(self, block, every_function=every_function)

    monkeypatch.setattr(seen_functions.SeenFunctions, "__init__", noted)
    policy = OddPolicy(lambda block, *given: (function or functional.scaled_dot_product_attention)(*given))
    expected = policy.act()
    with (
        va.record(tmp_path / "a.zarr", policy, layout=layout(), bits=23, queries="all", durable=False) as run,
        run.episodes([{"task_id": 0, "episode_index": 0, "instruction": ""}]) as episodes,
    ):
        for number in range(2):
            for step in range(2):
                with episodes.replan(env_step=[step]):
                    assert torch.equal(policy.act(), expected)
            if number == 0:
                episodes.next_episode(0, task_id=0, episode_index=1, instruction="")
    assert asked == ways
    rows = [episode.read("joint/rows") for episode in open_store(tmp_path / "a.zarr").episodes]
    assert all((one == rows[0][0]).all() for episode in rows for one in episode)
