"""From selectors to the keys of one replan: objects by coverage, several sites, unknown names and empty groups."""

from __future__ import annotations

import numpy as np
import pytest

from vla_attention.capture.interventions.resolution import (
    ReplanPlace,
    TooFewKeys,
    empty_replans,
    has_empty_group,
    make_editors,
    run_vocabularies,
    selectors_of,
    site_tokens,
)
from vla_attention.schemas.groupings.resolve import EmptyGroup
from vla_attention.schemas.groupings.vocabulary import EpisodeTokens, SceneObject
from vla_attention.schemas.interventions import AttentionScale, AttentionUniform, Interventions, KeyKnockout
from vla_attention.schemas.layout import PatchGrid, Piece, Prompt, Role, SiteLayout, Span

PLACE = ReplanPlace(0, 2, 7)
GRID = PatchGrid(2, 2, 8, 8)
JOINT = SiteLayout(
    "joint",
    (
        Span("base", "image", 0, 4, camera="base", grid=GRID),
        Span("prompt", "text", 4, 9),
        Span("actions", "action", 9, 11),
    ),
)
SELF = SiteLayout("self", (Span("base", "latent", 0, 4, camera="base", grid=GRID), Span("action", "latent", 4, 6)))
CROSS = SiteLayout("cross", (Span("text", "text", 0, 5),))
OBJECTS = (SceneObject("bowl_1", "object", True), SceneObject("plate_1", "object", False))
#: (patch, object)
COVERAGE = {"base": np.array([[0.25, 0.0], [1.0, 0.0], [0.0, 0.0], [0.0, 0.0]], dtype=np.float32)}
IMAGE, B, W, P, A = Role.IMAGE, Role.BOS, Role.INSTRUCTION, Role.PADDING, Role.ACTION


def prompt(first: int) -> Prompt:
    pieces = (Piece(first + 1, "the", 0, 3), Piece(first + 2, "bo", 4, 6), Piece(first + 3, "wl", 6, 8))
    return Prompt("the bowl", pieces, (0, 8))


def joint(coverage=COVERAGE):
    roles = {"joint": np.array([IMAGE, IMAGE, IMAGE, IMAGE, B, W, W, W, P, A, A], dtype=np.uint8)}
    return site_tokens((JOINT,), roles, prompt(4), OBJECTS, coverage)


def two_sites():
    roles = {
        "self": np.array([IMAGE, IMAGE, IMAGE, IMAGE, A, A], dtype=np.uint8),
        "cross": np.array([W, W, W, W, P], dtype=np.uint8),
    }
    return site_tokens((SELF, CROSS), roles, prompt(0), OBJECTS, COVERAGE)


def vocabularies(tokens: dict[str, EpisodeTokens]):
    sites = [there.layout for there in tokens.values()]
    return run_vocabularies(sites, ["the bowl", "lift the red mug"], OBJECTS)


def values(edit, tokens, place=PLACE) -> dict[str, np.ndarray]:
    """Values of the only edit of each site that has one."""
    interventions = Interventions(**{"keys" if isinstance(edit, KeyKnockout) else "attention": (edit,)})
    editors = make_editors(interventions, tokens, vocabularies(tokens), place)
    return {site: editor.edits[0].values for site, editor in editors.items()}


def test_objects_by_the_area_that_they_cover():
    np.testing.assert_allclose(
        values(KeyKnockout("object:bowl_1"), joint())["joint"], [0.75, 0, 1, 1, 1, 1, 1, 1, 1, 1, 1]
    )
    half = KeyKnockout("object:bowl_1 | word:bowl", weight=0.5)
    np.testing.assert_allclose(values(half, joint())["joint"], [0.875, 0.5, 1, 1, 1, 1, 0.5, 0.5, 1, 1, 1])


def test_keep_leaves_actions_and_what_is_never_valid():
    kept = values(KeyKnockout("object:bowl_1 | word:the", keep=True), joint())["joint"]
    np.testing.assert_allclose(kept, [0.25, 1, 0, 0, 0, 1, 0, 0, 1, 1, 1])


def test_attention_scaled_and_uniform():
    scaled = values(AttentionScale("object:bowl_1", 3.0), joint())["joint"]
    np.testing.assert_allclose(scaled[:3], [1.5, 3, 1])
    uniform = values(AttentionUniform("words:all"), joint())["joint"]
    np.testing.assert_allclose(uniform, [0, 0, 0, 0, 0, 1, 1, 1, 0, 0, 0])


def test_each_name_counts_at_the_sites_that_have_it():
    tokens = two_sites()
    both = values(KeyKnockout("camera:base | word:bowl"), tokens)
    np.testing.assert_array_equal(both["self"], [0, 0, 0, 0, 1, 1])
    np.testing.assert_array_equal(both["cross"], [1, 1, 0, 0, 1])
    assert list(values(KeyKnockout("camera:base", keep=True), tokens)) == []  # only action keys are left
    assert list(values(KeyKnockout("* - camera:base"), tokens)) == ["self"]
    assert list(values(KeyKnockout("word:bowl", keep=True), tokens)) == ["cross"]
    readers = KeyKnockout("role:image", queries="prefix", query_selector="word:bowl")
    editors = make_editors(Interventions(keys=(readers,)), joint(), vocabularies(joint()), PLACE)
    np.testing.assert_array_equal(np.flatnonzero(editors["joint"].edits[0].readers), [6, 7])


def test_the_random_control():
    control = KeyKnockout("object:bowl_1", random_seed=0)  # 1.25 keys
    drawn = {int(np.flatnonzero(values(control, joint(), ReplanPlace(0, 0, i))["joint"] == 0)[0]) for i in range(60)}
    assert drawn == {2, 3, 4, 5, 6, 7}  # neither the object, nor padding, nor actions
    sliver = joint({"base": np.array([[0.25, 0.0], [0, 0], [0, 0], [0, 0]], dtype=np.float32)})
    assert (values(control, sliver)["joint"] == 0).sum() == 1
    with pytest.raises(TooFewKeys, match=r"5 keys .*replan 7 of task000_episode002, .* 3"):
        values(KeyKnockout("camera:base | word:the", random_seed=0), joint())


def test_empty_groups():
    interventions = Interventions(
        keys=(KeyKnockout("object:plate_1"), KeyKnockout("word:mug", keep=True)),
        attention=(AttentionUniform("words:all"),),
    )
    assert selectors_of(interventions) == ("object:plate_1", "word:mug", "words:all")
    tokens = joint()
    empty = empty_replans(interventions, tokens, vocabularies(tokens))
    assert {selector: list(replans) for selector, replans in empty.items()} == {
        "object:plate_1": [True],
        "word:mug": [True],
        "words:all": [False],
    }
    with pytest.raises(EmptyGroup, match=r"'object:plate_1' .*replan 7 of task000_episode002: .*--allow-empty"):
        has_empty_group(interventions, tokens, vocabularies(tokens), PLACE)
    # What is empty changes nothing, `keep` neither.
    editors = make_editors(Interventions(keys=interventions.keys), tokens, vocabularies(tokens), PLACE)
    assert editors == {}


def test_a_camera_whose_keys_are_all_masked_is_an_empty_group():
    roles = {"joint": np.array([P, P, P, P, B, W, W, W, P, A, A], dtype=np.uint8)}
    tokens = site_tokens((JOINT,), roles, prompt(4), OBJECTS, COVERAGE)
    change = Interventions(keys=(KeyKnockout("camera:base"),))
    with pytest.raises(EmptyGroup, match="'camera:base'"):
        has_empty_group(change, tokens, vocabularies(tokens), PLACE)
