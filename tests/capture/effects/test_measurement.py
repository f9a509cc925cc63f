"""Effects are what single calls give: each condition is made again by itself, through `act` and its editors."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from tests.capture.interventions.test_interventions_on_policies import policy_named
from tests.kit.cosmos_helpers import INSTRUCTION
from tests.kit.policy_inputs import make_observation
from vla_attention.capture.effects.arguments import EffectSettings
from vla_attention.capture.effects.conditions import UNCHANGED, planned_effects, refuse_both
from vla_attention.capture.effects.measurement import EffectMeasurement
from vla_attention.capture.interventions.changed_inputs import CallContext, changed_inputs
from vla_attention.capture.interventions.resolution import (
    ReplanPlace,
    interventions_for,
    make_editors,
    run_vocabularies,
    site_tokens,
)
from vla_attention.capture.policies.pi.call_variants import _Group
from vla_attention.capture.policies.pi.embedded import random_weights
from vla_attention.capture.policies.pi.model import model_from_state
from vla_attention.capture.policies.pi.policy import PiPolicy
from vla_attention.capture.policies.policy import CallVariant
from vla_attention.schemas.errors import BadArgument
from vla_attention.schemas.groupings.vocabulary import SceneObject
from vla_attention.schemas.groupings.words import words_of
from vla_attention.schemas.interventions import Interventions, KeyKnockout, PromptChange

TEXT = "put the red bowl on the plate"
SIBLINGS = {0: ("put the blue bowl on the plate", "put the red cup on the stove", "open the drawer")}
OBJECTS = (SceneObject("red_cube", "object", of_interest=True), SceneObject("table", "background", of_interest=False))


def measurement(policy, items=("text", "cameras"), readers=("all", "action"), **settings) -> EffectMeasurement:
    planned = planned_effects(EffectSettings(items, readers, **settings), policy, seed=3)
    said: list[str] = []
    made = EffectMeasurement(policy, planned, SIBLINGS, said.append)
    made.lines = said
    return made


def coverage_of(policy) -> dict[str, np.ndarray]:
    """Red cube on parts of some patches, the table everywhere else."""
    coverage = {}
    for camera in policy.cameras:
        patches = next(len(s.patch_keys(camera.name)) for s in policy.sites if camera.name in s.cameras)
        red = np.random.default_rng(patches).choice([0.0, 0.25, 1.0], patches)
        coverage[camera.name] = np.stack([red, 1 - red], axis=1).astype(np.float32)
    return coverage


def call_of(policy, replan: int = 0):
    given = policy.prepare(make_observation(0), TEXT)
    context = CallContext(0, 2, replan, objects=OBJECTS, coverage=coverage_of(policy))
    return given, context, policy.act(given, 11)


def by_hand(policy, condition: Interventions, given, context) -> np.ndarray | None:
    """Actions of one call under a condition, by the ways of a rerun; None where the condition changes nothing."""
    tokens = site_tokens(policy.sites, given.key_role, given.prompt, context.objects, context.coverage)
    editors = None
    if condition.keys:
        placed = interventions_for(condition, policy)
        place = ReplanPlace(context.task_id, context.episode_index, context.replan)
        names = run_vocabularies(policy.sites, [TEXT], context.objects)
        editors = make_editors(placed, tokens, names, place)
        if not editors:
            return None
    if condition.changes_input:
        given = policy.prepare_again(changed_inputs(given.given, condition, policy.sites, context))
    seed = 11
    if condition.noise is not None:
        seed = policy.replan_noise_seed(condition.noise.seed, context.task_id, context.episode_index, context.replan)
    return policy.act(given, seed, None, editors)


def lengths_differ(policy, given, condition, context) -> bool:
    changed = policy.prepare_again(changed_inputs(given.given, condition, policy.sites, context))
    return len(changed.prompt.pieces) != len(given.prompt.pieces)


@pytest.mark.parametrize("name", ["pi05", "pi0"])
def test_every_effect_is_that_of_a_single_call(name):
    policy = policy_named(name)
    run = measurement(policy, ("text", "cameras", "objects", "tokens"), ("all", "action", "pictures", "text"))
    # Noise and random keys are drawn anew for every replan.
    given, context, actions = call_of(policy, replan=3)
    effects = run.begin().measure(given, 11, actions, context)
    names = [condition.name for condition in effects.conditions]
    assert len(set(names)) == len(names)
    # Prompts with another number of tokens are among them.
    assert effects.measured == tuple(range(len(names)))
    assert any(one.prompt and lengths_differ(policy, given, one, context) for one in effects.conditions)
    for number, change in zip(effects.measured, effects.change, strict=True):
        expected = by_hand(policy, effects.conditions[number], given, context) - actions
        np.testing.assert_allclose(change * effects.units, expected, atol=1e-5, err_msg=names[number])
    by_name = {names[n]: change for n, change in zip(effects.measured, effects.change, strict=True)}
    for name, reader in (("red", "_queries_all"), ("bowl", "")):
        assert np.abs(by_name[f"without_word_{name}{reader}"]).max() > 1e-4
    assert np.abs(by_name["unchanged"]).max() < 1e-5
    assert {"prompt_synonyms_red_blue", "prompt_synonyms_bowl_cup", "prompt_synonyms_plate_stove"} <= set(names)


def test_without_controls_nothing_is_kept_alone_and_no_random_keys_are_cut():
    policy = policy_named("pi05")
    given, context, actions = call_of(policy)
    kinds = {}
    for controls in (True, False):
        run = measurement(policy, ("text", "cameras", "grouping:default"), controls=controls)
        effects = run.begin().measure(given, 11, actions, context)
        kinds[controls] = {condition.name for condition in effects.conditions}
    left_out = {name for name in kinds[True] if name.startswith(("only_", "random_"))}
    assert left_out
    assert kinds[False] == kinds[True] - left_out


def test_what_is_cut_is_stored_for_each_entry():
    policy = policy_named("pi05")
    given, context, actions = call_of(policy)
    effects = measurement(policy, ("text", "objects")).begin().measure(given, 11, actions, context)
    cut = {effects.conditions[n].name: row for n, row in zip(effects.measured, effects.cut["joint"], strict=True)}
    (red,) = [word for word in words_of(given.prompt) if word.text == "red"]
    assert np.flatnonzero(cut["without_word_red"]).tolist() == list(red.keys)
    assert not cut["unchanged"].any()
    assert not cut["noise"].any()
    (span,) = policy.sites[0].camera_spans(policy.cameras[0].name)
    np.testing.assert_allclose(
        cut["without_object_red_cube"][span.start : span.stop], context.coverage[policy.cameras[0].name][:, 0], 1e-6
    )
    words = [row for name, row in cut.items() if name.startswith("without_word")]
    largest = max(int(row.sum()) for row in words)
    assert cut[next(name for name in cut if name.startswith("random_word"))].sum() == largest


def test_a_batch_of_any_size_gives_the_same(monkeypatch):
    policy = policy_named("pi05")
    given, context, actions = call_of(policy)
    whole = measurement(policy).begin().measure(given, 11, actions, context)
    one_by_one = measurement(policy)
    one_by_one._batch = 1
    np.testing.assert_allclose(one_by_one.begin().measure(given, 11, actions, context).change, whole.change, atol=1e-5)


def test_replans_between_are_not_measured():
    policy = policy_named("pi05")
    episode = measurement(policy, every=2).begin()
    for replan, wanted in ((0, True), (1, False), (2, True)):
        given, context, actions = call_of(policy, replan)
        assert (episode.measure(given, 11, actions, context) is not None) is wanted


def test_fewer_steps_are_compared_with_as_many():
    """With fewer steps every action is another: the effect is that of the item alone."""
    policy = policy_named("pi05")
    given, context, actions = call_of(policy)
    few = measurement(policy, denoise_steps=1).begin().measure(given, 11, actions, context)
    names = [few.conditions[number].name for number in few.measured]
    assert "unchanged" not in names
    (one,) = policy.act_variants([CallVariant(given, 11)], 1, 8)
    changed = by_hand_in_one_step(policy, given, context)
    expected = (changed - one) / np.array(few.units)
    np.testing.assert_allclose(few.change[names.index("without_word_red_queries_all")], expected, atol=1e-5)


def by_hand_in_one_step(policy, given, context):
    """One Euler step of the model itself, with the prefix's editor."""
    condition = Interventions(keys=(KeyKnockout('word:"red"', queries="all"),))
    tokens = site_tokens(policy.sites, given.key_role, given.prompt, (), {})
    editors = make_editors(condition, tokens, run_vocabularies(policy.sites, [TEXT], ()), ReplanPlace(0, 2, 0))
    steps = policy.model.config.num_denoise_steps
    object.__setattr__(policy.model.config, "num_denoise_steps", 1)
    try:
        return policy.act(given, 11, None, editors)
    finally:
        object.__setattr__(policy.model.config, "num_denoise_steps", steps)


def test_cosmos_is_called_once_for_each_condition():
    policy = policy_named("cosmos")
    given = policy.prepare(make_observation(0), INSTRUCTION)
    context = CallContext(0, 2, 3)
    actions = policy.act(given, 11)
    run = EffectMeasurement(policy, planned_effects(EffectSettings(("text", "cameras")), policy, 3), {}, print)
    effects = run.begin().measure(given, 11, actions, context)
    assert UNCHANGED not in effects.conditions
    assert set(effects.cut) == {site.name for site in policy.sites}
    for number, change in zip(effects.measured, effects.change, strict=True):
        condition = effects.conditions[number]
        tokens = site_tokens(policy.sites, given.key_role, given.prompt, (), {})
        names = run_vocabularies(policy.sites, [given.prompt.instruction_text], ())
        editors = make_editors(condition, tokens, names, ReplanPlace(0, 2, 3)) if condition.keys else None
        inputs = given
        if condition.changes_input:
            inputs = policy.prepare_again(changed_inputs(given.given, condition, policy.sites, context))
        seed = 11 if condition.noise is None else policy.replan_noise_seed(condition.noise.seed, 0, 2, 3)
        expected = policy.act(inputs, seed, None, editors) - actions
        np.testing.assert_allclose(change * effects.units, expected, atol=1e-6, err_msg=condition.name)


def test_a_call_among_the_others_that_differs_is_refused(monkeypatch):
    policy = policy_named("pi05")
    given, context, actions = call_of(policy)
    run = measurement(policy)
    effects = run.begin().measure(given, 11, actions + 1e-3 * run.units, context)
    assert [effects.conditions[number] for number in effects.measured] == [UNCHANGED]
    np.testing.assert_allclose(effects.change, -1e-3, rtol=0.02)
    assert any("refused" in line for line in run.lines)


def test_numbers_that_are_not_finite_are_left_out(monkeypatch):
    policy = policy_named("pi05")
    given, context, actions = call_of(policy)
    make = type(policy).act_variants

    def spoiled(self, variants, num_steps, batch):
        made = make(self, variants, num_steps, batch)
        made[3] = made[3] * np.nan
        return made

    monkeypatch.setattr(type(policy), "act_variants", spoiled)
    run = measurement(policy)
    effects = run.begin().measure(given, 11, actions, context)
    assert 3 not in effects.measured
    whole = measurement(policy)
    monkeypatch.undo()
    assert {*effects.measured, 3} == set(whole.begin().measure(given, 11, actions, context).measured)
    assert any(effects.conditions[3].name in line for line in run.lines)


def test_what_a_policy_has_not_is_refused():

    with pytest.raises(BadArgument, match="prefix"):
        planned_effects(EffectSettings(("text",), ("pictures",)), policy_named("cosmos"), 0)

    with pytest.raises(BadArgument, match="interventions"):
        refuse_both(Interventions(keys=(KeyKnockout("role:image"),)))
    refuse_both(Interventions(prompt=PromptChange("empty")))


def test_words_of_the_first_instruction_have_no_entry_in_another_one():
    """A data set's task may change within an episode; its conditions are those of the first call."""
    policy = policy_named("pi05")
    episode = measurement(policy).begin()
    given, context, actions = call_of(policy)
    first = episode.measure(given, 11, actions, context)
    other = policy.prepare(make_observation(0), "open the drawer")
    later = replace(context, replan=1)
    second = episode.measure(other, 11, policy.act(other, 11), later)
    names = {second.conditions[number].name for number in second.measured}
    assert second.conditions == first.conditions
    assert "without_word_the" in names
    assert "without_word_bowl" not in names


def test_single_keys_of_cosmos_are_of_the_site_that_reads_text():
    policy = policy_named("cosmos")
    given = policy.prepare(make_observation(0), "pick up , the bowl !")
    planned = planned_effects(EffectSettings(("tokens",), ("action",)), policy, 3)
    effects = (
        EffectMeasurement(policy, planned, {}, print)
        .begin()
        .measure(given, 11, policy.act(given, 11), CallContext(0, 2, 0))
    )
    keys = [number for number in effects.measured if effects.conditions[number].keys]
    assert keys
    for place, number in enumerate(effects.measured):
        if number in keys:
            assert effects.cut["cross"][place].sum() == 1
            assert not effects.cut["self"][place].any()


def test_the_other_noise_is_another_one_whatever_the_seed():
    policy = policy_named("pi05")
    for seed in (0, 7, 2**63 - 1):
        planned = planned_effects(EffectSettings(("text",)), policy, seed)
        assert planned.seed != seed
        assert 0 <= planned.seed < 2**63


def test_in_bfloat16_a_call_that_is_the_same_gives_the_same_to_the_bit(monkeypatch):
    """What bfloat16 rounds depends on the batch, which a processor does not show: here the batch itself is added."""
    sample, batches = _Group.sample, []

    def of_batch(group, calls, prefixes):
        batches.append(len(calls))
        return sample(group, calls, prefixes) + 0.01 * len(batches)

    monkeypatch.setattr(_Group, "sample", of_batch)
    config = policy_named("pi05").model.config
    model = model_from_state(config, random_weights(config, 0), dtype=torch.bfloat16)
    policy = policy_named("pi05")
    policy = PiPolicy(model, policy.tokenizer, policy.processing, policy.source)
    given, _, _ = call_of(policy)
    variants = [CallVariant(given, seed) for seed in (11, 12, 13, 11, 14, 15, 11, 16)]
    for batch, sizes in ((3, [3, 3, 3, 2]), (5, [5, 4]), (8, [8])):
        made = policy.act_variants(variants, policy.num_denoise_steps, batch)
        for number, variant in enumerate(variants):
            assert np.array_equal(made[number], made[0]) is (variant.noise_seed == 11)
        assert batches == sizes
        batches.clear()
