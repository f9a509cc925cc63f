"""Interventions on whole policies: pi0, pi0.5 and Cosmos Policy of test size."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch

from tests.kit.cosmos_helpers import INSTRUCTION, recorders_of
from tests.kit.policy_inputs import KeepAll, make_observation
from vla_attention.capture.interventions.factors import QueryWithoutKeys
from vla_attention.capture.interventions.resolution import (
    ReplanPlace,
    interventions_for,
    make_editors,
    run_vocabularies,
    site_tokens,
)
from vla_attention.capture.policies.identity import PolicySource
from vla_attention.capture.policies.pi.embedded import DUMMY_CONFIG, build_random_model, builtin_stats, dummy_policy
from vla_attention.capture.policies.pi.policy import PiPolicy
from vla_attention.capture.policies.pi.processing import openpi_processing
from vla_attention.capture.policies.pi.tokenizer import PromptTokenizer
from vla_attention.capture.policies.policy import changed_actions
from vla_attention.capture.policies.sentencepiece_model import EMBEDDED_TOKENIZER
from vla_attention.schemas.errors import BadArgument
from vla_attention.schemas.interventions import AttentionScale, AttentionUniform, Interventions, KeyKnockout
from vla_attention.schemas.layout import Role

PLACE = ReplanPlace(3, 1, 4)


def dummy_pi0() -> PiPolicy:
    config = dataclasses.replace(DUMMY_CONFIG, pi05=False, discrete_state_input=False, max_token_len=48)
    return PiPolicy(
        build_random_model(config, 0),
        PromptTokenizer(EMBEDDED_TOKENIZER),
        openpi_processing(config, builtin_stats()),
        PolicySource("dummy-pi0", "random weights, seed 0", "seeded", untrained=True),
    )


def dummy_cosmos():
    pytest.importorskip("diffusers")
    from vla_attention.capture.policies.cosmos.embedded import DUMMY_CONFIG, random_policy

    return random_policy("untrained-tiny", DUMMY_CONFIG)


MAKERS = {"pi05": dummy_policy, "pi0": dummy_pi0, "cosmos": dummy_cosmos}
POLICIES: dict[str, object] = {}


def policy_named(name: str):
    if name not in POLICIES:
        POLICIES[name] = MAKERS[name]()
    return POLICIES[name]


@pytest.fixture(params=list(MAKERS))
def policy(request):
    return policy_named(request.param)


@pytest.fixture(params=["pi05", "pi0"])
def pi(request):
    return policy_named(request.param)


def editors_of(policy, given, *edits, place=PLACE):
    keys = tuple(edit for edit in edits if isinstance(edit, KeyKnockout))
    attention = tuple(edit for edit in edits if not isinstance(edit, KeyKnockout))
    interventions = interventions_for(Interventions(keys=keys, attention=attention), policy)
    tokens = site_tokens(policy.sites, given.key_role, given.prompt, (), {})
    return make_editors(interventions, tokens, run_vocabularies(policy.sites, [INSTRUCTION], ()), place)


def prepared(policy, seed: int = 0, instruction: str = INSTRUCTION):
    return policy.prepare(make_observation(seed), instruction)


def rows_of(policy, given, *edits) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Actions, and rows (denoise, layer, head, query, key) of the action queries by site."""
    keep = {site.name: KeepAll() for site in policy.sites}
    actions = policy.act(given, 0, keep, editors_of(policy, given, *edits) or None)
    rows = {}
    for site, collector in keep.items():
        (start, stop), *others = collector.queries
        assert not others
        rows[site] = collector.stacked()[:, :, 0, :, start:stop]
    return actions, rows


def first_camera(policy) -> str:
    return policy.cameras[0].name


def keys_of(policy, camera: str) -> tuple[str, slice]:
    site = next(site for site in policy.sites if camera in site.cameras)
    (span,) = site.camera_spans(camera)
    return site.name, slice(span.start, span.stop)


@pytest.mark.parametrize("queries", ["action", "all"])
def test_what_is_knocked_out_gets_exactly_zero(policy, queries):
    given, camera = prepared(policy), first_camera(policy)
    plain_actions, plain = rows_of(policy, given)
    actions, rows = rows_of(policy, given, KeyKnockout(f"camera:{camera}", queries=queries))
    site, keys = keys_of(policy, camera)
    assert (rows[site][..., keys] == 0).all()
    assert (plain[site][..., keys] > 0).all()
    for there in rows.values():
        np.testing.assert_allclose(there.sum(-1), 1, atol=1e-5)
    assert (actions != plain_actions).any()
    # In the first layer nothing else has changed yet: the other keys share what is left.
    if queries == "action" or not policy.has_prefix:
        expected = plain[site][0, 0].copy()
        expected[..., keys] = 0
        np.testing.assert_allclose(rows[site][0, 0], expected / expected.sum(-1, keepdims=True), atol=1e-5)


def test_without_a_change_every_bit_stays(policy):
    given, camera = prepared(policy), first_camera(policy)
    plain = policy.act(given, 0)
    masked = [site for site in policy.sites if (given.key_role[site.name] == Role.PADDING).any()]
    for edits in (
        [AttentionScale(f"camera:{camera}", 1.0), KeyKnockout(f"camera:{camera}", weight=0.0, queries="all")],
        [KeyKnockout("role:padding", queries="all"), AttentionUniform("role:padding")] if masked else [],
    ):
        editors = editors_of(policy, given, *edits)
        np.testing.assert_array_equal(policy.act(given, 0, None, editors), plain)
        np.testing.assert_array_equal(policy.act(given, 0, recorders_of(policy, given), editors), plain)


def test_recording_does_not_change_the_intervention(policy):
    given = prepared(policy)
    edits = [
        KeyKnockout(f"camera:{first_camera(policy)}", weight=0.7, queries="all", heads=(1,)),
        AttentionUniform("words:all"),
    ]
    actions = policy.act(given, 0, None, editors_of(policy, given, *edits))
    recorded = policy.act(given, 0, recorders_of(policy, given), editors_of(policy, given, *edits))
    np.testing.assert_array_equal(actions, recorded)
    assert (actions != policy.act(given, 0)).any()


def test_an_action_that_cannot_read_the_pictures_does_not_depend_on_them(pi):
    """The planted dependence: with all ways from the pictures to the actions cut, other pictures change no bit."""
    cut = KeyKnockout("role:image", queries="all")
    one, other = prepared(pi, 0), prepared(pi, 1)
    # Same state and prompt, other pictures.
    images = {name: x for name, x in other.tensors.items() if name.startswith("image:")}
    changed = dataclasses.replace(one, tensors={**one.tensors, **images})
    assert (pi.act(one, 0) != pi.act(changed, 0)).any()
    without = [pi.act(given, 0, None, editors_of(pi, given, cut)) for given in (one, changed)]
    np.testing.assert_array_equal(*without)
    # The action queries alone are not enough: words carry what was seen.
    direct = [pi.act(given, 0, None, editors_of(pi, given, KeyKnockout("role:image"))) for given in (one, changed)]
    assert (direct[0] != direct[1]).any()
    # Unless words could not read the pictures.
    apart = KeyKnockout("role:image", queries="prefix", query_selector="span:prompt")
    both = [pi.act(given, 0, None, editors_of(pi, given, KeyKnockout("role:image"), apart)) for given in (one, changed)]
    # pi0's state query reads the pictures, too, and the action queries read it.
    assert np.array_equal(*both) == pi.model.config.pi05


def test_an_action_that_cannot_read_the_text_does_not_depend_on_it(policy):
    """The reverse; in Cosmos words are keys of the cross site only."""
    one = prepared(policy)
    sites = [site for site in policy.sites if any(span.kind == "text" for span in site.spans)]
    layout = sites[0]
    words = np.flatnonzero(one.key_role[layout.name] == Role.INSTRUCTION)
    name = "tokens" if "tokens" in one.tensors else "text"
    text = one.tensors[name].clone()
    first = next(span.start for span in layout.spans if span.kind == "text")
    index = torch.from_numpy(words - first)
    text[0, index] = text[0, index.flip(0)]
    changed = dataclasses.replace(one, tensors={**one.tensors, name: text})
    assert (policy.act(one, 0) != policy.act(changed, 0)).any()
    cut = KeyKnockout("role:instruction", queries="all")
    without = [policy.act(given, 0, None, editors_of(policy, given, cut)) for given in (one, changed)]
    np.testing.assert_array_equal(*without)


def test_keep_knocks_out_all_other_valid_keys_but_actions(policy):
    given, camera = prepared(policy), first_camera(policy)
    _, rows = rows_of(policy, given, KeyKnockout(f"camera:{camera}", keep=True))
    site, keys = keys_of(policy, camera)
    stays = given.key_role[site] == Role.ACTION
    stays[keys] = True
    assert (rows[site][..., ~stays] == 0).all()
    assert (rows[site][..., keys].sum(-1) > 0).all()
    for other in set(rows) - {site}:
        np.testing.assert_array_equal(rows[other][0, 0] > 0, True)


def test_the_random_control_takes_as_many_other_keys_and_is_drawn_for_each_replan(policy):
    given, camera = prepared(policy), first_camera(policy)
    site, _ = keys_of(policy, camera)
    span = next(span for s in policy.sites if s.name == site for span in s.spans if span.camera == camera)
    selector = f"keys:{span.start}-{span.start + 1}" if len(policy.sites) == 1 else f"patch:{camera}[0:1,0:2]"
    knockout = KeyKnockout(selector, random_seed=5)
    chosen = []
    for place in (PLACE, ReplanPlace(3, 1, 5), PLACE):
        (edit,) = editors_of(policy, given, knockout, place=place)[site].edits
        chosen.append(np.flatnonzero(edit.values == 0))
    assert [len(drawn) for drawn in chosen] == [2, 2, 2]
    np.testing.assert_array_equal(chosen[0], chosen[2])
    assert (chosen[0] != chosen[1]).any()
    assert not {span.start, span.start + 1} & set(np.concatenate(chosen))
    invalid = (Role.PADDING, Role.MASKED_IMAGE, Role.ACTION)
    assert not np.isin(given.key_role[site][np.concatenate(chosen)], invalid).any()


def test_a_query_is_left_without_keys(policy):
    given = prepared(policy)
    site = policy.sites[-1].name
    first = 1 if policy.family == "pi0" else 0  # pi0's first query is the state's
    everything = f"keys:0-{policy.sites[-1].num_keys - 1}" if len(policy.sites) == 1 else "span:text"
    with pytest.raises(QueryWithoutKeys, match=rf"'{site}', layer 0, denoise step 0, head 0, query {first}"):
        changed_actions(policy, given, 0, None, editors_of(policy, given, KeyKnockout(everything)))


def test_chosen_places(policy):
    given, camera = prepared(policy), first_camera(policy)
    site, keys = keys_of(policy, camera)
    _, plain = rows_of(policy, given)
    last = policy.num_denoise_steps - 1
    edit = KeyKnockout(f"camera:{camera}", layers=(1,), heads=(0,), denoise_steps=(last,))
    _, rows = rows_of(policy, given, edit)
    np.testing.assert_array_equal(rows[site][:last], plain[site][:last])
    np.testing.assert_array_equal(rows[site][last, 0], plain[site][last, 0])
    np.testing.assert_array_equal(rows[site][last, 1, 1:], plain[site][last, 1, 1:])
    assert (rows[site][last, 1, 0][..., keys] == 0).all()


def test_the_prefix_runs_once_before_all_denoise_steps(pi):
    with pytest.raises(BadArgument, match="prefix"):
        editors_of(pi, prepared(pi), KeyKnockout("role:image", queries="all", denoise_steps=(0,)))
