from __future__ import annotations

import re

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.kit.strategies import episode_tokens, groupings
from tests.kit.tokens import random_rows
from vla_attention.schemas.groupings.builtin_groupings import BUILTIN_GROUPINGS, find_grouping
from vla_attention.schemas.groupings.grouping import Grouping, GroupingError
from vla_attention.schemas.groupings.resolve import OverlappingGroups, check_names, resolve
from vla_attention.schemas.groupings.selectors import SelectorError
from vla_attention.schemas.groupings.vocabulary import EpisodeTokens, SceneObject, collect_vocabulary
from vla_attention.schemas.layout import PatchGrid, Piece, Prompt, Role, SiteLayout, Span
from vla_attention.schemas.segments import segment_masses, segment_members, segments_of, weights_on_segments


@pytest.fixture
def tokens() -> EpisodeTokens:
    """Two cameras (the second one masked) of 2 x 2 patches, 'put the red bowl on the plate', 2 actions, 2 replans."""
    layout = SiteLayout(
        "joint",
        (
            Span("base", "image", 0, 4, camera="base", grid=PatchGrid(2, 2, 28, 28)),
            Span("blank", "image", 4, 8, camera="blank", grid=PatchGrid(2, 2, 28, 28)),
            Span("prompt", "text", 8, 20),
            Span("actions", "action", 20, 22),
        ),
    )
    text = "put the red bowl on the plate\n"
    bounds = [(0, 3), (3, 7), (7, 11), (11, 14), (14, 16), (16, 19), (19, 23), (23, 29)]  # "bowl" is two pieces
    pieces = tuple(Piece(9 + i, text[a:b], a, b) for i, (a, b) in enumerate(bounds))
    roles = np.zeros((2, 22), dtype=np.uint8)
    roles[:, 0:4] = Role.IMAGE
    roles[:, 4:8] = Role.MASKED_IMAGE
    roles[:, 8] = Role.BOS
    roles[:, 9:17] = Role.INSTRUCTION
    roles[:, 17] = Role.TEMPLATE
    roles[:, 18:20] = Role.PADDING
    roles[:, 20:22] = Role.ACTION
    coverage = np.zeros((2, 4, 3), dtype=np.float32)
    coverage[:, :, 2] = 1.0
    coverage[0, 0] = [0.25, 0.0, 0.75]
    coverage[1, 3] = [0.5, 0.5, 0.0]
    objects = (
        SceneObject("bowl_1", "object", True),
        SceneObject("robot", "robot", False),
        SceneObject("background", "background", False),
    )
    return EpisodeTokens(
        layout, roles, (Prompt(text, pieces, (0, 29)),), np.zeros(2, dtype=int), objects, {"base": coverage}
    )


def weights(tokens: EpisodeTokens, selector: str) -> np.ndarray:
    return resolve(Grouping("g", {"g": (selector,)}, overlap=True), tokens).weights[:, :, 0]


def test_objects_weigh_patches_by_covered_area_at_each_replan(tokens):
    bowl = weights(tokens, "object:bowl_1")
    assert bowl[0, 0] == 0.25
    assert bowl[1, 3] == 0.5
    assert bowl.sum() == 0.75
    assert np.array_equal(weights(tokens, "object:@interest"), bowl)
    assert weights(tokens, "object:@robot")[1, 3] == 0.5


def test_set_operations_on_objects_are_exact(tokens):
    without = weights(tokens, "camera:base - object:bowl_1")
    assert without[0, :4].tolist() == [0.75, 1, 1, 1]
    both = weights(tokens, "object:bowl_1 | object:@robot")
    assert both[1, 3] == 1.0
    assert not weights(tokens, "object:bowl_1 & object:@robot").any()
    assert np.array_equal(weights(tokens, "object:bowl_1 & camera:base"), weights(tokens, "object:bowl_1"))


def test_patch_regions_count_from_the_top_left(tokens):
    assert np.flatnonzero(weights(tokens, "patch:base[0:1,1:2]")[0]).tolist() == [1]
    assert np.flatnonzero(weights(tokens, "patch:base[1:,:]")[0]).tolist() == [2, 3]


def test_key_numbers_include_both_ends(tokens):
    assert np.flatnonzero(weights(tokens, "keys:8-10")[0]).tolist() == [8, 9, 10]


def test_counts_of_keys_and_valid_keys(tokens):
    resolved = resolve(Grouping("g", {"bowl": ("object:bowl_1",), "words": ("role:instruction",)}), tokens)
    np.testing.assert_allclose(resolved.num_keys, [[0.25, 8], [0.5, 8]])
    assert resolved.num_valid.tolist() == [16]


def test_overlap_is_an_error_that_names_groups_key_and_word(tokens):
    grouping = Grouping("g", {"nouns": ("word:bowl",), "text": ("span:prompt",)})
    with pytest.raises(OverlappingGroups, match=r"'nouns' and 'text' .* 2 .* 12 .*'prompt', ' bo?w?'"):
        resolve(grouping, tokens)
    resolve(Grouping("g", grouping.groups, overlap=True), tokens)


@pytest.mark.parametrize(
    ("selector", "given", "nearest"),
    [
        ("camera:bass", "bass", "base"),
        ("span:promt", "promt", "prompt"),
        ("role:txt", "txt", "text"),
        ("word:bowls", "bowls", "bowl"),
        ("object:bowl_2", "bowl_2", "bowl_1"),
        ("object:@robots", "@robots", "@robot"),
        ("patch:bas[0:1,0:1]", "bas", "base"),
        ("frame:frame0", "frame0", ""),
    ],
)
def test_unknown_names_say_what_exists(tokens, selector, given, nearest):
    grouping = Grouping("g", {"g": (selector,)})
    with pytest.raises(LookupError if selector.startswith(("role", "frame")) else SelectorError) as caught:
        check_names(grouping, collect_vocabulary([tokens]))
    assert f"'{given}'" in str(caught.value)
    assert not nearest or f"'{nearest}'" in str(caught.value)


@pytest.mark.parametrize(
    "selector", ["patch:base[0:3,0:1]", "patch:base[1:1,0:1]", "keys:5-22", "keys:x", "patch:base"]
)
def test_regions_outside_the_layout_are_errors(tokens, selector):
    with pytest.raises(SelectorError, match="expected"):
        weights(tokens, selector)


@pytest.mark.parametrize("name", BUILTIN_GROUPINGS)
@given(data=st.data())
def test_builtin_groupings_take_every_key_exactly_once(name, data):
    tokens = data.draw(episode_tokens(fitted=True))
    grouping = BUILTIN_GROUPINGS[name](collect_vocabulary([tokens]))
    check_names(grouping, collect_vocabulary([tokens]))
    total = resolve(grouping, tokens).weights.sum(axis=2)
    np.testing.assert_allclose(total, 1.0, atol=1e-6)


@given(data=st.data())
def test_masses_of_a_complete_disjoint_grouping_sum_to_the_row_sum(data):
    tokens = data.draw(episode_tokens(fitted=True))
    grouping = data.draw(groupings(tokens))
    rows = random_rows(tokens, (2, 3), data.draw(st.integers(0, 2**16)))
    resolved = resolve(grouping, tokens)
    masses = np.einsum(
        "rlhk,rkg->rlhg", rows.astype(float), np.broadcast_to(resolved.weights, (*rows.shape[::3], len(resolved.names)))
    )
    np.testing.assert_allclose(masses.sum(axis=-1), rows.sum(axis=-1, dtype=float), rtol=1e-5)


@given(data=st.data())
def test_masses_of_segments_are_those_of_rows(data):
    tokens = data.draw(episode_tokens(fitted=True))
    grouping = data.draw(groupings(tokens))
    rows = random_rows(tokens, (2,), data.draw(st.integers(0, 2**16)))
    resolved = resolve(grouping, tokens)
    segments = segments_of(tokens.layout, tokens.key_role)
    members = segment_members(tokens.layout, tokens.key_role, segments)
    assert (members.sum(axis=2) == 1).all()
    on_segments, cut = weights_on_segments(resolved.weights, members)
    atoms = np.stack([segment_masses(rows[r], members[r]) for r in range(tokens.num_replans)])
    by_segment = np.einsum(
        "rls,rsg->rlg", atoms, np.broadcast_to(on_segments, (tokens.num_replans, *on_segments.shape[1:]))
    )
    by_key = np.einsum(
        "rlk,rkg->rlg", rows, np.broadcast_to(resolved.weights, (tokens.num_replans, *resolved.weights.shape[1:]))
    )
    whole = ~cut.any(axis=0)
    np.testing.assert_allclose(by_segment[..., whole], by_key[..., whole], rtol=1e-4, atol=1e-7)


@given(data=st.data())
def test_union_and_difference_partition(data):
    tokens = data.draw(episode_tokens(fitted=True))
    a, b = (data.draw(groupings(tokens)).groups["g0"][0] for _ in range(2))
    union, only_a, only_b, both = (
        weights(tokens, text) for text in (f"({a}) | ({b})", f"({a}) - ({b})", f"({b}) - ({a})", f"({a}) & ({b})")
    )
    np.testing.assert_allclose(union, only_a + only_b + both, atol=1e-6)


def test_reference_takes_the_published_key_ranges(tokens):
    grouping = BUILTIN_GROUPINGS["reference"](collect_vocabulary([tokens]))
    resolved = resolve(grouping, tokens)
    # One camera of 4 patches, then 256 keys, which reach beyond the last one here, as the scripts' slices do.
    assert resolved.num_keys.tolist() == [[4, 18, 0]]
    assert {"4", "21", "256"} <= set(re.findall(r"\d+", grouping.description))
    for text_keys in (1, 12):
        given = find_grouping(f"reference:{text_keys}", collect_vocabulary([tokens]))
        assert given.name == f"reference-{text_keys}"
        resolved = resolve(given, tokens)
        assert resolved.num_keys.tolist() == [[4, text_keys, 18 - text_keys]]
        assert resolved.weights[0, 4 : 4 + text_keys, 1].all()


def test_reference_on_pi05_is_the_published_scripts_slices():
    """Their default is a prompt of 256 slots, whatever the model's is: their text is the second camera."""
    cameras = [Span(f"camera{i}", "image", 256 * i, 256 * (i + 1), camera=f"camera{i}") for i in range(3)]
    spans = (*cameras, Span("prompt", "text", 768, 968), Span("actions", "action", 968, 978))
    roles = np.repeat([Role.IMAGE, Role.PADDING, Role.ACTION], [768, 200, 10]).astype(np.uint8)[None]
    tokens = EpisodeTokens(SiteLayout("joint", spans), roles)
    row = np.random.default_rng(0).random(978)
    for name, num_text in (("reference", 256), ("reference:200", 200), ("reference:5000", 5000)):
        published = [row[:256].sum(), row[256 : 256 + num_text].sum(), row[256 + num_text :].sum()]
        found = row @ resolve(find_grouping(name, collect_vocabulary([tokens])), tokens).weights[0]
        np.testing.assert_allclose(found, published)
    with pytest.raises(GroupingError, match="'reference:0'"):
        find_grouping("reference:0", collect_vocabulary([tokens]))


def test_reference_on_latent_frames_and_where_it_makes_no_sense():
    frames = tuple(
        Span(name, "latent", i, i + 1, camera="primary" if name == "primary" else None)
        for i, name in enumerate(("blank", "primary", "action"))
    )
    roles = np.array([[Role.BLANK, Role.IMAGE, Role.ACTION]], dtype=np.uint8)
    latent = EpisodeTokens(SiteLayout("self", frames), roles)
    resolved = resolve(BUILTIN_GROUPINGS["reference"](collect_vocabulary([latent])), latent)
    assert resolved.weights[0].T.tolist() == [[0, 1, 0], [1, 0, 0]]
    text = EpisodeTokens(
        SiteLayout("cross", (Span("text", "text", 0, 1),)), np.array([[Role.INSTRUCTION]], dtype=np.uint8)
    )
    with pytest.raises(GroupingError, match=r"'reference'.*--site"):
        BUILTIN_GROUPINGS["reference"](collect_vocabulary([text]))
    with pytest.raises(GroupingError, match="'reference:200'"):
        find_grouping("reference:200", collect_vocabulary([latent]))


@given(data=st.data())
def test_what_shows_no_picture_is_no_picture(data):
    """Pictures, border and masked patches share all keys of cameras, a patch by what of it shows a picture."""
    tokens = data.draw(episode_tokens(fitted=True))
    image, border = (weights(tokens, f"role:{role}") for role in ("image", "border"))
    seen = np.isin(tokens.static_roles, [Role.IMAGE, Role.BORDER])
    rest = np.zeros(tokens.layout.num_keys) if tokens.border is None else tokens.border
    for found, wanted in ((image, 1 - rest), (border, rest)):
        np.testing.assert_allclose(found, np.broadcast_to(np.where(seen, wanted, 0.0), found.shape), atol=1e-6)
