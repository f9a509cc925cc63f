"""Effects of `va.record`: what single calls give that are changed by hand, and nothing of them in the run."""

from __future__ import annotations

import warnings
from contextlib import suppress

import numpy as np
import pytest
import torch
from msgspec.structs import replace
from torch import nn

import vla_attention as va
from tests.capture.torch_policies.stateful_policies import (
    BufferPolicy,
    GeneratorPolicy,
    QueuePolicy,
    SamplingPolicy,
    layout_with_prefix,
)
from tests.kit.questions import question_about
from tests.kit.small_torch_policy import HORIZON, PROMPT, given, small_layout
from tests.kit.small_torch_variants import PATCHES, TokenPolicy, token_layout
from vla_attention.analyze.core.recorded_effects import recorded_effects
from vla_attention.capture.policies.noise import noise_seed
from vla_attention.schemas.errors import BadArgument, Note
from vla_attention.schemas.groupings.vocabulary import SceneObject
from vla_attention.schemas.stores.reader import open_store
from vla_attention.schemas.stores.store_format import RunMismatch
from vla_attention.schemas.stores.verify import verify_store

TEXT, SIBLINGS = "pick the bowl", ["pick the plate", "pick up"]
PREFIX, KEYS, BOWL = 5 + PROMPT, 5 + PROMPT + HORIZON, 7
ALL_READERS = va.EffectSettings(("text", "cameras", "objects", "tokens"), ("all", "action", "pictures", "text"))
TEXT_AND_CAMERAS = va.EffectSettings(("text", "cameras"), ("all", "action"))


def inputs(replan, text=TEXT):
    """What one call of a sampling policy is given."""
    return {name: value for name, value in given(seed=replan, text=text).items() if name != "noise"}


def repeat_of(policy, replan):
    def again(call):
        return policy.sample(**{**inputs(replan, call.instruction), "pictures": call.frames["front"]})

    return again


def fill(path, policy, repeat=repeat_of, replans=2, say="default", episodes=1, first=0, siblings=SIBLINGS, **settings):
    """Record episodes; returns the store, the actions, and what was said."""
    settings = {
        "layout": layout_with_prefix(),
        "tokenizer": policy.tokenizer,
        "denoise_steps": "all",
        "durable": False,
        "bits": 23,
        "effects": TEXT_AND_CAMERAS,
    } | settings
    actions = []
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        with va.record(path, policy, **settings) as run:
            for number in range(first, first + episodes):
                facts = {"task_id": 0, "episode_index": number, "instruction": TEXT, "siblings": siblings}
                with run.episode(**facts) as episode:
                    for replan in range(replans):
                        frames = {"front": inputs(replan)["pictures"]}
                        repeats = None if repeat is None else repeat(policy, replan)
                        with episode.replan(env_step=replan, frames=frames, repeat=repeats) as block:
                            block.actions = policy.sample(**inputs(replan))
                        actions.append(torch.as_tensor(block.actions).clone())
    store = open_store(path)
    assert verify_store(store) == []
    return store, actions, [str(one.message) for one in said if issubclass(one.category, Note)]


def changes_of(store, replan=0, episode=0):
    """The changes of actions by the name of their condition."""
    episode = store.episodes[episode]
    effects = episode.attributes.effects
    if not effects.replan:
        return {}
    entries = zip(effects.replan, effects.condition, episode.read("effects/change"), strict=True)
    return {effects.conditions[number].name: change for of, number, change in entries if of == replan}


def by_hand(monkeypatch, policy, cut, readers, replan, noise):
    """Actions of a call whose masks were changed in the policy's own code.

    cut: keys that are not read. readers: the queries, by their keys, that do not read them; other than action queries
    keep their own.
    """
    attend = nn.functional.scaled_dot_product_attention

    def without(q, k, v, attn_mask):
        queries = q.shape[2]
        first = 0 if queries == PREFIX else PREFIX
        mask = attn_mask.clone().expand(-1, -1, queries, -1).clone()
        for query in range(queries):
            for key in cut:
                if first + query in readers and key < k.shape[2] and not (first == 0 and query == key):
                    mask[:, :, query, key] = False
        return attend(q, k, v, attn_mask=mask)

    with monkeypatch.context() as patch:
        patch.setattr(nn.functional, "scaled_dot_product_attention", without)
        return policy.act(**inputs(replan), noise=noise)


def in_plain_torch(q, k, v, attn_mask):
    """Attention by hand, as SmolVLA computes it."""
    logits = (q @ k.transpose(2, 3) * q.shape[-1] ** -0.5).masked_fill(~attn_mask, torch.finfo(q.dtype).min)
    return torch.softmax(logits, dim=-1) @ v


@pytest.mark.parametrize("kernel", [nn.functional.scaled_dot_product_attention, in_plain_torch])
def test_every_effect_is_that_of_a_call_that_is_changed_by_hand(tmp_path, monkeypatch, kernel):
    monkeypatch.setattr(nn.functional, "scaled_dot_product_attention", kernel)
    policy = SamplingPolicy()
    torch.manual_seed(5)
    noise = torch.randn(2, 1, HORIZON, 2)
    torch.manual_seed(5)
    store, actions, said = fill(tmp_path / "a.zarr", policy, effects=ALL_READERS)
    assert len(said) == 1
    action, prefix = set(range(PREFIX, KEYS)), set(range(PREFIX))
    pictures, text = {0, 1, 2, 3}, {4, 5, 6, 7, 10}
    by_name = {
        "without_word_bowl_queries_all": ({BOWL}, action | prefix),
        "without_word_bowl": ({BOWL}, action),
        "without_word_bowl_queries_prefix_of_role_image": ({BOWL}, pictures),
        "without_visual_queries_all": (pictures, action | prefix),
        "without_visual_queries_prefix_of_role_bos_or_role_template_or_role_instruction_or_role_state": (
            pictures,
            text | {8},
        ),
        "only_visual_queries_all": ({4, 5, 6, 7, 8, 10}, action | prefix),
        "without_camera_front": (pictures, action),
    }
    for replan in range(2):
        changes = changes_of(store, replan)
        assert np.abs(changes["unchanged"]).max() < 1e-5
        for name, (cut, readers) in by_name.items():
            expected = by_hand(monkeypatch, policy, cut, readers, replan, noise=noise[replan]) - actions[replan]
            np.testing.assert_allclose(changes[name], expected[0], atol=1e-5, err_msg=name)
            assert np.abs(changes[name]).max() > 1e-3
        exchanged = policy.act(**inputs(replan, "pick the plate"), noise=noise[replan]) - actions[replan]
        np.testing.assert_allclose(changes["prompt_synonyms_bowl_plate"], exchanged[0], atol=1e-5)
        grey = torch.full((1, 3, 8, 8), 128 / 255)
        blank = policy.act(**{**inputs(replan), "pictures": grey, "noise": noise[replan]}) - actions[replan]
        np.testing.assert_allclose(changes["front_blank"], blank[0], atol=1e-5)
        with torch.random.fork_rng():
            torch.manual_seed(noise_seed(1, 0, 0, replan))
            other = policy.sample(**inputs(replan)) - actions[replan]
        np.testing.assert_allclose(changes["noise"], other[0], atol=1e-5)
    effects = store.episodes[0].attributes.effects
    assert effects.units == (1.0, 1.0)
    names = [effects.conditions[number].name for number in effects.condition]
    cut = dict(zip(names, store.episodes[0].read("joint/cut"), strict=True))
    assert np.flatnonzero(cut["without_word_bowl_queries_all"]).tolist() == [BOWL]
    assert not cut["unchanged"].any()
    assert cut["random_word_pick"].sum() == 1


@pytest.mark.parametrize("kind", [SamplingPolicy, BufferPolicy])
def test_actions_rows_and_random_numbers_are_those_of_a_run_without_effects(tmp_path, kind):
    results = []
    for effects in (None, TEXT_AND_CAMERAS):
        torch.manual_seed(5)
        store, actions, said = fill(tmp_path / f"{effects is None}.zarr", kind(), replans=2, effects=effects)
        assert said == []
        results.append((store, actions, torch.random.get_rng_state().tolist()))
    (plain, plain_actions, plain_state), (measured, actions, state) = results
    assert all(map(torch.equal, actions, plain_actions))
    assert state == plain_state
    for episode, other in zip(plain.episodes, measured.episodes, strict=True):
        for name in ("joint/rows", "joint/atoms", "joint/contribution", "actions", "joint/key_role"):
            assert np.array_equal(episode.read(name), other.read(name)), name
        assert np.array_equal(episode.uniform("joint"), other.uniform("joint"))
    for replan in range(2):
        changes = changes_of(measured, replan)
        assert np.abs(changes["unchanged"]).max() < 1e-5
        assert np.abs(changes["noise"]).max() > 1e-2
        assert np.abs(changes["without_word_bowl"]).max() > 1e-4


@pytest.mark.parametrize("kind", [GeneratorPolicy, QueuePolicy])
def test_what_a_policy_keeps_from_call_to_call_is_noticed(tmp_path, kind):
    store, _, said = fill(tmp_path / "a.zarr", kind())
    assert said
    assert "without_word_bowl" not in changes_of(store, 0)


@pytest.mark.parametrize(
    ("settings", "named"),
    [
        ({"effects": "word"}, "'word'.* text, cameras, objects, tokens"),
        ({"layout": small_layout()}, "'all': .*'small'"),
        ({"repeat": None}, "step 0 of task000_episode000"),
    ],
)
def test_what_cannot_be_measured_is_named(tmp_path, settings, named):
    with pytest.raises(BadArgument, match=named):
        fill(tmp_path / "a.zarr", SamplingPolicy(), **settings)


def test_a_repeat_that_raises_is_said_once_and_its_entries_are_absent(tmp_path):
    def failing(policy, replan):
        def again(call):
            if "plate" in call.instruction:
                raise TypeError("no plates here")
            return repeat_of(policy, replan)(call)

        return again

    torch.manual_seed(5)
    store, actions, said = fill(tmp_path / "a.zarr", SamplingPolicy(), failing)
    assert [one for one in said if "TypeError: no plates here" not in one] == []
    torch.manual_seed(5)
    _, expected, _ = fill(tmp_path / "b.zarr", SamplingPolicy(), effects=None)
    assert all(map(torch.equal, actions, expected))
    for replan in range(2):
        assert "prompt_synonyms_bowl_plate" not in changes_of(store, replan)
        assert {"front_blank", "without_word_bowl_queries_all"} <= set(changes_of(store, replan))


def test_a_repeat_of_another_call_is_refused(tmp_path):
    def other(policy, replan):
        return lambda call: repeat_of(policy, replan)(call) + 1e-3

    store, _, said = fill(tmp_path / "a.zarr", SamplingPolicy(), other)
    assert len(said) == 2
    for replan in range(2):
        assert list(changes_of(store, replan)) == ["unchanged"]
        np.testing.assert_allclose(changes_of(store, replan)["unchanged"], 1e-3, rtol=0.01)


def test_a_prompt_of_another_length_is_not_exchanged(tmp_path):
    policy = SamplingPolicy()
    encode = policy.tokenizer.encode
    policy.tokenizer.encode = lambda text: [one for number in encode(text) for one in [number] * (1 + (number == 7))]
    store, _, said = fill(tmp_path / "a.zarr", policy)
    assert len(said) == 1
    assert "prompt_synonyms_bowl_plate" not in changes_of(store)
    assert "front_blank" in changes_of(store)


def test_replans_between_and_resuming(tmp_path):
    settings = va.EffectSettings(("text",), ("action",), every=2)
    store, _, _ = fill(tmp_path / "a.zarr", SamplingPolicy(), replans=4, effects=settings)
    assert sorted(set(store.episodes[0].attributes.effects.replan)) == [0, 2]
    assert store.attributes.recording.effects.readers == ("action",)
    for other in (None, "text", va.EffectSettings(("text",), ("action",))):
        with pytest.raises(RunMismatch, match="recording"):
            fill(tmp_path / "a.zarr", SamplingPolicy(), effects=other, resume=True)


def test_groups_of_a_grouping(tmp_path):
    settings = va.EffectSettings(("text", "grouping:default"), ("action",))
    store, _, _ = fill(tmp_path / "a.zarr", SamplingPolicy(), effects=settings)
    found = changes_of(store)
    assert {"without_linguistic", "only_linguistic", "without_group_visual", "only_group_visual"} <= set(found)
    assert not any("group_linguistic" in name for name in found)  # it is the item 'linguistic'


@pytest.mark.parametrize("readers", [("all", "action"), ("action",)])
def test_a_map_hides_blocks_of_patches_as_a_group_hides_them(tmp_path, readers):
    selector = "patch:front[0:1,0:2]"
    (tmp_path / "top.toml").write_text(f'[groups]\ntop = "{selector}"\nrest = "*"\n')
    settings = va.EffectSettings((f"grouping:{tmp_path / 'top.toml'}", "map:2x1"), readers)
    store, _, _ = fill(tmp_path / "a.zarr", SamplingPolicy(), effects=settings)
    one, change = store.episodes[0].attributes.effects.map, store.episodes[0].read("effects/patch_change")
    assert (one.way, one.reader, one.patch[:2]) == ("hidden", readers[0], (0, 1))
    suffix = "_queries_all" if readers[0] == "all" else ""
    np.testing.assert_allclose(change[0], changes_of(store)[f"without_group_top{suffix}"], atol=1e-6)
    assert np.abs(change[0]).max() > 1e-3


def test_objects_are_cut_by_the_share_that_they_cover(tmp_path, monkeypatch):
    policy = SamplingPolicy()
    share = np.array([[0.25, 0.75], [1, 0], [0, 1], [0, 1]], dtype=np.float32)
    things = [SceneObject("bowl", "object", of_interest=True), SceneObject("table", "object", of_interest=False)]
    settings = {"layout": layout_with_prefix(), "effects": va.EffectSettings(("objects",), ("action",))}
    torch.manual_seed(5)
    noise = torch.randn(1, HORIZON, 2)
    torch.manual_seed(5)
    with va.record(tmp_path / "a.zarr", policy, durable=False, **settings) as run:
        facts = {"task_id": 0, "episode_index": 0, "instruction": TEXT, "objects": things}
        with run.episode(**facts) as episode:
            call = repeat_of(policy, 0)
            frames = {"front": inputs(0)["pictures"]}
            with episode.replan(env_step=0, frames=frames, coverage={"front": share}, repeat=call) as replan:
                replan.actions = policy.sample(**inputs(0))
    attend = nn.functional.scaled_dot_product_attention

    def without(q, k, v, attn_mask):
        bias = torch.zeros(attn_mask.shape).masked_fill(~attn_mask, -torch.inf)
        if q.shape[2] == HORIZON:
            bias[..., 0] += float(np.log(0.75))
            bias[..., 1] = -torch.inf
        return attend(q, k, v, attn_mask=bias)

    monkeypatch.setattr(nn.functional, "scaled_dot_product_attention", without)
    expected = policy.act(**inputs(0), noise=noise) - replan.actions
    change = changes_of(open_store(tmp_path / "a.zarr"))["without_object_bowl"]
    np.testing.assert_allclose(change, expected[0], atol=1e-5)


def test_calls_whose_queries_are_all_tokens(tmp_path, monkeypatch):
    """A policy that generates tokens: the prompt is read by the first call, whose last query is the action's."""
    policy, layout = TokenPolicy(), token_layout()
    layout = replace(layout, rules=(replace(layout.rules[0], tokens="joint"),))
    picture = torch.rand(3, 8, 8, generator=torch.Generator().manual_seed(0))
    logits = []
    policy.head.register_forward_hook(lambda *given: logits.append(given[2]))

    def act(text=TEXT):
        logits.clear()
        policy.act(picture, text)
        return torch.cat(logits).detach()

    settings = {"layout": layout, "tokenizer": policy.tokenizer, "effects": "text,cameras", "durable": False}
    with (
        pytest.warns(Note) as said,
        va.record(tmp_path / "a.zarr", policy, **settings) as run,
        run.episode(task_id=0, episode_index=0, instruction=TEXT, siblings=["pick up bowl"]) as episode,
        episode.replan(env_step=0, repeat=lambda call: act(call.instruction)) as replan,
    ):
        replan.actions = act()
    assert len(said) == 2
    changes = changes_of(open_store(tmp_path / "a.zarr"))
    # The first patch sees itself only, and still does.
    assert {"without_visual_queries_all", "only_linguistic_queries_all"} <= set(changes)
    the, attend = PATCHES + 2, nn.functional.scaled_dot_product_attention
    for name, readers in (("without_word_the_queries_all", "all"), ("without_word_the", "action")):

        def without(q, k, v, attn_mask, readers=readers):
            mask, queries = attn_mask.clone(), q.shape[2]
            if readers == "action":
                mask[-1, the] = False
            else:
                mask[:, the] = False
                if queries > 1:
                    mask[the, the] = True
            return attend(q, k, v, attn_mask=mask)

        with monkeypatch.context() as patch:
            patch.setattr(nn.functional, "scaled_dot_product_attention", without)
            expected = act() - replan.actions
        np.testing.assert_allclose(changes[name], expected, atol=1e-5, err_msg=name)
        assert np.abs(changes[name]).max() > 1e-3
    exchanged = act("pick up bowl") - replan.actions
    np.testing.assert_allclose(changes["prompt_synonyms_the_up"], exchanged, atol=1e-5)


def test_a_prefix_that_is_no_pass_over_the_sites_keys(tmp_path):
    """Cut off for the action queries alone, and a line says so."""
    layout = small_layout()
    never = replace(layout, rules=(*layout.rules, va.CallRule("patches", None, tokens="joint")))
    store, _, said = fill(tmp_path / "a.zarr", SamplingPolicy(), layout=never)
    assert len(said) == 1
    assert "'small'" in said[0]
    assert not any(name.endswith("_queries_all") for name in changes_of(store))
    assert "without_word_bowl" in changes_of(store)


def test_whether_words_get_through_is_asked_until_an_episode_is_there(tmp_path):
    """The first episode is dropped: the next one has what was seen of it."""
    policy = SamplingPolicy()
    with va.record(tmp_path / "a.zarr", policy, layout=layout_with_prefix(), tokenizer=policy.tokenizer) as run:
        for number in range(3):
            with suppress(KeyError), run.episode(task_id=0, episode_index=number, instruction=TEXT) as episode:
                with episode.replan(env_step=0, frames={"front": inputs(0)["pictures"]}) as block:
                    block.actions = policy.sample(**inputs(0))
                if number == 0:
                    raise KeyError
    seen = [episode.attributes.plumbing is not None for episode in open_store(tmp_path / "a.zarr").episodes]
    assert seen == [True, False]


class Linear(nn.Module):
    """Attention without a softmax."""

    def __init__(self, plain):
        super().__init__()
        self.qkv, self.out = plain.qkv, plain.out

    def forward(self, tokens, cache, mask):
        q, k, v = self.qkv(tokens).chunk(3, dim=-1)
        cache.append(k.mT @ v)
        return self.out(q @ sum(cache) / len(cache))


@pytest.mark.parametrize("hybrid", [False, True])
def test_blocks_without_softmax_are_named_beside_the_effects(tmp_path, hybrid):
    policy, layout = SamplingPolicy(), layout_with_prefix()
    if hybrid:
        policy.blocks[1].attention = Linear(policy.blocks[1].attention)
        (joint,) = layout.sites
        layout = replace(layout, sites=(replace(joint, keys=replace(joint.keys, layers=(0, 2))),))
    store, _, said = fill(tmp_path / "a.zarr", policy, layout=layout)
    effects = store.episodes[0].attributes.effects
    assert effects.silent_blocks == (("blocks.1",) if hybrid else ())
    assert sum("blocks.1" in line for line in said) == hybrid
    found = recorded_effects(question_about(tmp_path / "a.zarr"), attention=False)
    assert any("blocks.1" in note for note in found.notes) == hybrid


def deaf_to(policy, replan):
    return lambda call: policy.sample(**inputs(replan))


def fails(policy, replan):
    return lambda call: policy.nothing


def other_actions(policy, replan):
    return lambda call: policy.sample(**inputs(replan + 1, call.instruction))


@pytest.mark.parametrize(
    ("repeat", "changed", "moved", "why"),
    [
        (repeat_of, True, True, False),
        (deaf_to, False, False, False),
        (fails, None, None, True),
        (other_actions, None, None, True),
        (None, None, None, True),
    ],
)
def test_whether_the_words_get_through(tmp_path, repeat, changed, moved, why):
    policy = SamplingPolicy()
    torch.manual_seed(0)
    store, actions, said = fill(tmp_path / "a.zarr", policy, repeat, effects=None)
    first, *_ = (episode.attributes.plumbing for episode in store.episodes)
    assert (first.unread, first.input_changed) == ((), changed)
    assert moved is (None if first.action_changed is None else first.action_changed > 1e-3)
    assert bool(first.why_not) == why
    assert bool(said) == (changed is not True and repeat is not None)
    resumed, *_ = fill(tmp_path / "a.zarr", policy, repeat, effects=None, resume=True, first=1)
    assert [episode.attributes.plumbing for episode in resumed.episodes] == [first, None]
    torch.manual_seed(0)
    plain, of_plain, _ = fill(tmp_path / "b.zarr", policy, None, effects=None)
    assert all(torch.equal(mine, its) for mine, its in zip(actions, of_plain, strict=True))
    assert store.episodes[0].attributes.arrays == plain.episodes[0].attributes.arrays
