"""Several episodes whose policy calls are one call with a batch: each row is stored as if it had been alone."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from msgspec.structs import replace
from torch import nn

import vla_attention as va
from tests.kit.small_torch_policy import WORDS, SmallPolicy, WordTokenizer, given, small_layout
from vla_attention.capture.torch_policies.prompts import PromptDoesNotFit
from vla_attention.capture.torch_policies.record import record
from vla_attention.capture.torch_policies.recorded_episodes import NothingRecorded, RecordingStopped
from vla_attention.capture.torch_policies.replan_text import KeysShifted
from vla_attention.schemas.errors import BadArgument
from vla_attention.schemas.interventions import knockout
from vla_attention.schemas.layout import Role
from vla_attention.schemas.stores.reader import open_store
from vla_attention.schemas.stores.verify import verify_store

TEXTS = ["pick the bowl", "pick up the plate", "pick the red bowl"]


def start(path, policy, **changes):
    changes = {"layout": small_layout(), "tokenizer": policy.tokenizer, "bits": 23, "durable": False} | changes
    return record(path / "a.zarr", policy, **changes)


def joined(step):
    """What the policy is given for all three rows."""
    rows = [given(seed=10 * step + row, text=text) for row, text in enumerate(TEXTS)]
    whole = {name: torch.cat([row[name] for row in rows]) for name in ("pictures", "states", "noise")}
    return whole | {"texts": [row["texts"][0] for row in rows]}


def episodes(first=0):
    return [
        {"task_id": row, "episode_index": first, "instruction": text, "seed": row} for row, text in enumerate(TEXTS)
    ]


def stored(path):
    store = open_store(path / "a.zarr")
    assert verify_store(store) == []
    return {one.name: one for one in store.episodes}


@pytest.mark.parametrize("changes", [{}, {"interventions": knockout("word:pick")}])
def test_rows_of_a_batch_are_those_of_single_calls(tmp_path, changes):
    policy = SmallPolicy()
    with start(tmp_path / "batch", policy, **changes) as run, run.episodes(episodes()) as batch:
        for step in range(2):
            inputs = joined(step)
            expected = policy.act(**inputs)
            with batch.replan(
                env_step=step, state=inputs["states"], frames=[{"front": p} for p in inputs["pictures"]]
            ) as replan:
                replan.actions = policy.act(**inputs)
            assert changes or torch.equal(replan.actions, expected)
        for row, episode in enumerate(batch):
            episode.success = row == 1
    with start(tmp_path / "single", policy, **changes) as run:
        for row, facts in enumerate(episodes()):
            with run.episode(**facts) as episode:
                for step in range(2):
                    inputs = given(seed=10 * step + row, text=TEXTS[row])
                    with episode.replan(
                        env_step=step, state=inputs["states"], frames={"front": inputs["pictures"]}
                    ) as replan:
                        replan.actions = policy.act(**inputs)
                episode.success = row == 1
    together, alone = stored(tmp_path / "batch"), stored(tmp_path / "single")
    assert list(together) == list(alone) == [f"task00{row}_episode000" for row in range(3)]
    for name, episode in alone.items():
        other = together[name]
        assert other.attributes.prompts == episode.attributes.prompts
        assert other.attributes.success == episode.attributes.success
        assert set(other.attributes.arrays) == set(episode.attributes.arrays)
        for array in episode.attributes.arrays:
            np.testing.assert_allclose(other.read(array), episode.read(array), atol=1e-5, err_msg=array)


def test_rows_that_have_ended_and_episodes_that_follow(tmp_path):
    policy = SmallPolicy()
    with start(tmp_path, policy) as run, run.episodes(episodes()) as batch:
        for step in range(3):
            with batch.replan(env_step=step, active=[True, step < 2, True]):
                policy.act(**joined(step))
        batch[2].success = True
        follower = batch.next_episode(2, task_id=2, episode_index=1, instruction=TEXTS[2])
        with batch.replan(env_step=[3, 0, 0], active=[True, False, True]):
            policy.act(**joined(3))
        assert follower is batch[2]
    found = stored(tmp_path)
    counts = {name: episode.attributes.num_replans for name, episode in found.items()}
    assert counts == {
        "task000_episode000": 4,
        "task001_episode000": 2,
        "task002_episode000": 3,
        "task002_episode001": 1,
    }
    assert found["task002_episode000"].attributes.success is True


def test_mistakes_name_what_was_given(tmp_path):
    policy = SmallPolicy()
    with start(tmp_path, policy) as run:
        with pytest.raises(BadArgument, match=r"state has 2 .* 3 episodes"):
            record_one(run, policy, state=[[0.0], [0.0]])
        with pytest.raises(BadArgument, match="active"):
            record_one(run, policy, active=[False] * 3)
        with pytest.raises(RecordingStopped):
            record_one(run, policy, alone=True)
        with pytest.raises(NothingRecorded, match="task001_episode000"):
            record_one(run, policy, active=[True, False, True])
        # Episode 0 was stored before that of row 1 failed.
        assert [run.has(row, 0) for row in range(3)] == [True, False, False]


def record_one(run, policy, alone=False, **inputs):
    with run.episodes(episodes()) as batch:
        block = batch[0].replan(env_step=0) if alone else batch.replan(env_step=0, **inputs)
        with block:
            policy.act(**joined(0))


IMAGE = len(WORDS)  # the id of a placeholder for a patch


class OneQuery(nn.Module):
    def forward(self, keys: torch.Tensor, mask: torch.Tensor) -> torch.Tensor:
        query = torch.ones(len(keys), 1, 1, 8)
        return nn.functional.scaled_dot_product_attention(query, keys[:, None], keys[:, None], attn_mask=mask)


class PaddedPolicy(nn.Module):
    """Patches and words in one sequence, padded to the longest of the batch, and one action query at its end.

    ended: how many tokens it embeds behind them, which are no keys.
    """

    def __init__(self, side: str, ended: int = 0) -> None:
        super().__init__()
        torch.manual_seed(0)
        self.words, self.blocks = nn.Embedding(len(WORDS) + 1, 8), nn.ModuleList([OneQuery()])
        self.side, self.ended, self.tokenizer = side, ended, WordTokenizer()

    @torch.no_grad()
    def act(self, texts: list[str], length: int = 11) -> torch.Tensor:
        rows = [[IMAGE] * 4 + self.tokenizer.encode(text) for text in texts]
        pads = [[0] * (length - len(row)) for row in rows]
        ids = torch.tensor(
            [pad + row if self.side == "left" else row + pad for pad, row in zip(pads, rows, strict=True)]
        )
        keys = self.words(nn.functional.pad(ids, (0, self.ended), value=1))[:, :length]
        return self.blocks[0](keys, (ids != 0)[:, None, None])


def padded_layout(text) -> va.PolicyLayout:
    spans = (
        va.Span("image_front", "image", 0, 4, "front", va.PatchGrid(2, 2, 8, 8)),
        va.Span("prompt", "text", 4, 11),
    )
    site = va.RecordedSite(va.SiteLayout("joint", spans), (0, 1), {"image_front": "image", "prompt": "instruction"})
    return va.PolicyLayout(
        name="padded",
        family="padded",
        sites=(site,),
        rules=(va.CallRule(r"blocks\.(?P<block>\d+)", "joint"),),
        num_layers=1,
        num_heads=1,
        text=None if text is None else va.PromptText(("prompt",), "words", **text),
    )


@pytest.mark.parametrize("tokenizer", [True, False])
@pytest.mark.parametrize(
    ("text", "texts"),
    [
        ({"skip_ids": (IMAGE,)}, ["pick the bowl", "pick up the red bowl"]),
        ({"skip_ids": (IMAGE,)}, ["bowl", "pick up the red bowl"]),  # as many keys as there are patches
        ({"skip_ids": (IMAGE,), "skip_last": 2}, ["pick the bowl", "pick up the red bowl"]),
        ({"skip_first": 4}, ["pick the bowl", "pick up the red bowl"]),
        ({"skip_first": 4}, ["pick up the bowl", "pick the bowl"]),
        (None, ["pick up the bowl", "pick the bowl"]),
    ],
)
def test_padding_on_the_left_moves_the_keys_and_is_refused(tmp_path, texts, text, tokenizer):
    policy = PaddedPolicy("left", (text or {}).get("skip_last", 0))
    settings = {
        "layout": padded_layout(text),
        "tokenizer": policy.tokenizer if tokenizer else None,
        "contributions": False,
    }

    def act(side):
        policy.side = side
        with va.record(tmp_path / f"{side}.zarr", policy, **settings, durable=False) as run:
            facts = [
                {"task_id": row, "episode_index": 0, "instruction": row_text} for row, row_text in enumerate(texts)
            ]
            with run.episodes(facts) as found, found.replan(env_step=0) as replan:
                replan.actions = policy.act(texts)[:, 0]

    with pytest.raises(KeysShifted, match=r"'image_front'.*padding_side = 'right'"):
        act("left")
    act("right")
    for row_text, episode in zip(texts, open_store(tmp_path / "right.zarr").episodes, strict=True):
        roles = [Role(code).label for code in episode.read("joint/key_role")[0]]
        assert roles[:4] == ["image"] * 4
        assert roles.count("padding") == 11 - 4 - 2 - len(row_text.split())


class MaskedPolicy(PaddedPolicy):
    """Its rows are given with the keys that may be seen, as text of 0 and 1."""

    @torch.no_grad()
    def act(self, ids: list[int], seen: list[str]) -> torch.Tensor:
        mask = torch.tensor([[key == "1" for key in row] for row in seen])
        return self.blocks[0](self.words(torch.tensor([ids] * len(seen))), mask[:, None, None])


@pytest.mark.parametrize("text", [{"skip_ids": (IMAGE,)}, None])
@pytest.mark.parametrize("hidden", ["0110", "0101"])  # the edges of a wide picture, patches that are left out
def test_patches_that_are_hidden_for_other_reasons_are_not_padding(tmp_path, text, hidden):
    policy = MaskedPolicy("right")
    ids = [IMAGE] * 4 + policy.tokenizer.encode("pick up the red bowl")
    with va.record(tmp_path / "a.zarr", policy, layout=padded_layout(text), durable=False, contributions=False) as run:
        facts = [{"task_id": row, "episode_index": 0, "instruction": ""} for row in range(2)]
        with run.episodes(facts) as found, found.replan(env_step=0):
            policy.act(ids, ["1" * 11, hidden + "1" * 7])
    roles = [Role(code).label for code in open_store(tmp_path / "a.zarr").episodes[1].read("joint/key_role")[0]]
    assert roles[:4] == ["image" if seen == "1" else "masked_image" for seen in hidden]


def test_padding_on_the_left_of_a_text_before_the_patches(tmp_path):
    spans = (
        va.Span("head", "text", 0, 2),
        va.Span("image_front", "image", 2, 6, "front", va.PatchGrid(2, 2, 8, 8)),
        va.Span("prompt", "text", 6, 11),
    )
    roles = {"head": "template", "image_front": "image", "prompt": "instruction"}
    site = va.RecordedSite(va.SiteLayout("joint", spans), (0, 1), roles)
    policy, layout = MaskedPolicy("left"), replace(padded_layout(None), sites=(site,))
    with va.record(tmp_path / "a.zarr", policy, layout=layout, durable=False, contributions=False) as run:
        facts = [{"task_id": row, "episode_index": 0, "instruction": ""} for row in range(2)]
        with (
            pytest.raises(KeysShifted, match="row 1"),
            run.episodes(facts) as found,
            found.replan(env_step=0),
        ):
            policy.act([1] * 11, ["1" * 11, "000" + "1" * 8])


def test_a_padding_id_among_those_that_are_skipped_is_no_padding_on_the_left(tmp_path):
    policy = PaddedPolicy("right")
    layout = padded_layout({"skip_ids": (IMAGE, 0)})
    with (
        va.record(tmp_path / "a.zarr", policy, layout=layout, tokenizer=policy.tokenizer, durable=False) as run,
        pytest.raises(PromptDoesNotFit, match=r" 5 .* 7 .* skip_ids"),
        run.episode(task_id=0, episode_index=0, instruction="pick the bowl") as episode,
        episode.replan(env_step=0),
    ):
        policy.act(["pick the bowl"])


@pytest.mark.parametrize("what", ["masks", "coverage"])
def test_nothing_covers_a_camera_without_patches(tmp_path, what):
    layout = padded_layout(None)
    pooled = va.Span("image_front", "image", 0, 4, "front")
    site = replace(layout.sites[0], keys=replace(layout.sites[0].keys, spans=(pooled, layout.sites[0].keys.spans[1])))
    with (
        va.record(tmp_path / "a.zarr", PaddedPolicy("right"), layout=replace(layout, sites=(site,))) as run,
        pytest.raises(BadArgument, match="'front'"),
        run.episode(task_id=0, episode_index=0, instruction="") as episode,
        episode.replan(env_step=0, **{what: {"front": np.zeros((8, 8, 3), np.uint8)}}),
    ):
        pass
