"""Recorded queries that are words or patches: no number of the store is of an action, and it is said."""

from __future__ import annotations

import warnings

import pytest
import torch
from torch import Tensor, nn

import vla_attention as va
from vla_attention.schemas.errors import Note

WORDS, PATCHES, ACTIONS, WIDTH = 3, 4, 2, 8


class OneSequence(nn.Module):
    """Words, patches and actions read each other, once."""

    def __init__(self) -> None:
        super().__init__()
        torch.manual_seed(0)
        self.blocks = nn.ModuleList([nn.MultiheadAttention(WIDTH, 2, batch_first=True)])

    def act(self, tokens: Tensor) -> Tensor:
        with torch.no_grad():
            return self.blocks[0](tokens, tokens, tokens, need_weights=False)[0][0, -ACTIONS:]


@pytest.mark.parametrize(
    ("queries", "named"),
    [((0, 3), "prompt"), ((1, 5), "prompt, image_front"), ((-2, None), ""), ((6, 8), ""), ((0, 9), "")],
)
def test_queries_that_are_no_actions_are_named(tmp_path, queries, named):
    spans = (
        va.Span("prompt", "text", 0, 3),
        va.Span("image_front", "image", 3, 7, camera="front", grid=va.PatchGrid(2, 2, 8, 8)),
        va.Span("actions", "action", 7, 9),
    )
    roles = {"prompt": "instruction", "image_front": "image", "actions": "action"}
    layout = va.PolicyLayout(
        name="one",
        family="one",
        num_layers=1,
        num_heads=2,
        num_denoise_steps=1,
        sites=(va.RecordedSite(va.SiteLayout("joint", spans), queries, roles),),
        rules=(va.CallRule(r"blocks\.(?P<block>\d+)", "joint"),),
    )
    policy = OneSequence()
    policy.eval()
    with (
        warnings.catch_warnings(record=True) as notes,
        va.record(tmp_path / "a.zarr", policy, layout=layout, contributions=False) as run,
        run.episode(task_id=0, episode_index=0, instruction="go") as episode,
    ):
        warnings.simplefilter("always")
        for step in range(2):
            with episode.replan(env_step=step) as replan:
                replan.actions = policy.act(torch.randn(1, WORDS + PATCHES + ACTIONS, WIDTH))
    said = [str(note.message) for note in notes if note.category is Note and "RecordedSite" in str(note.message)]
    assert len(said) == bool(named)
    assert all(f"tokens of {named}." in one for one in said)
