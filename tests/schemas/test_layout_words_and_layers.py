from __future__ import annotations

import re

import pytest

from vla_attention.schemas.errors import BadArgument
from vla_attention.schemas.groupings.words import find_phrase, split_words, words_of
from vla_attention.schemas.layers import select_layers
from vla_attention.schemas.layout import PatchGrid, Piece, Prompt, Role, SiteLayout, Span, find_role
from vla_attention.schemas.stores.store_format import Recording


def span(name: str, start: int, stop: int, **more) -> Span:
    return Span(name, "text", start, stop, **more)


@pytest.mark.parametrize(
    ("spans", "named"),
    [
        ((span("a", 0, 2), span("b", 3, 4)), r"3\.\.4.* 2"),
        ((span("a", 0, 2), span("b", 1, 4)), r"1\.\.4.* 2"),
        ((span("a", 0, 0),), r"0\.\.0"),
        ((span("a", 0, 2), span("a", 2, 4)), "'a'"),
        ((span("a", 0, 2, grid=PatchGrid(1, 3, 14, 42)),), "3"),
    ],
)
def test_spans_must_tile_the_keys(spans, named):
    with pytest.raises(BadArgument, match=named):
        SiteLayout("joint", spans)


def test_a_layout_finds_spans_and_cameras():
    layout = SiteLayout("joint", (span("a", 0, 2, camera="cam"), span("b", 2, 5)))
    assert layout.num_keys == 5
    assert layout.span_of_key().tolist() == [0, 0, 1, 1, 1]
    assert [span.name for span in layout.camera_spans("cam")] == ["a"]
    with pytest.raises(LookupError, match="Existing: a, b"):
        layout.span("c")


def test_latent_frames_by_name_number_and_as_the_published_scripts_call_them():
    names = ("blank", "wrist", "primary", "action")
    spans = [
        Span(name, "latent", 2 * i, 2 * i + 2, camera=name if name in ("wrist", "primary") else None)
        for i, name in enumerate(names)
    ]
    layout = SiteLayout("self", tuple(spans))
    assert [layout.frame(name).name for name in ("wrist", "frame0", "curr_last")] == ["wrist", "blank", "primary"]
    with pytest.raises(LookupError, match="'action'"):
        layout.frame("actions")
    with pytest.raises(LookupError, match="'frame0'"):
        SiteLayout("joint", (span("a", 0, 2),)).frame("frame0")


def test_role_codes_never_change():
    # They are written in stores: a changed number would give old stores a new meaning.
    assert {role.label: int(role) for role in Role} == {
        "image": 1, "masked_image": 2, "bos": 3, "template": 4, "instruction": 5, "state": 6, "padding": 7,
        "action": 8, "proprio": 9, "blank": 10, "future": 11, "value": 12, "text": 13, "null": 14,
        "absent": 15, "learned": 16, "border": 17,
    }  # fmt: skip
    assert find_role("Image") is Role.IMAGE


def test_words_split_at_spaces_underscores_and_punctuation():
    text = "Pick_up the O'Brien's hand-held mug, (red)."
    assert [text[a:b] for a, b in split_words(text)] == ["Pick", "up", "the", "O'Brien's", "hand-held", "mug", "red"]
    text = "हिन्दी में प्याला, cafe\u0301!"  # vowel signs and accents belong to their words
    assert [text[a:b] for a, b in split_words(text)] == ["हिन्दी", "में", "प्याला", "cafe\u0301"]


def test_words_stop_at_the_instruction():
    text = "Task: put State here, State: 1 2"
    pieces = tuple(Piece(i, text[i : i + 1], i, i + 1) for i in range(len(text)))
    prompt = Prompt(text, pieces, (6, 20))
    words = words_of(prompt)
    assert [word.text for word in words] == ["put", "State", "here"]
    assert words[1].keys == tuple(range(10, 15))
    assert prompt.instruction_text == "put State here"


def test_a_phrase_is_whole_words_in_sequence_at_every_place():
    text = "the red mug and the red bowl"
    pieces = tuple(Piece(i, "", a, b) for i, (a, b) in enumerate(split_words(text)))
    words = words_of(Prompt(text, pieces, (0, len(text))))
    assert [word.keys[0] for word in find_phrase(words, "The RED")] == [0, 1, 4, 5]
    assert find_phrase(words, "red and") == ()
    assert find_phrase(words, "mu") == ()


def test_layer_numbers_of_the_published_scripts():
    chosen = select_layers([25, 0, 17], 18, "pi05")
    assert chosen.blocks == (7, 0, 17)
    assert chosen.labels == (25, 0, 17)
    assert "25 = block 7" in (chosen.note or "")
    assert select_layers([0, 8, 17], 18, "pi0").note is None
    published = select_layers([0, 8, 17, 25, 26, 27], 18, "pi05")
    assert published.blocks == (0, 8, 17, 7, 8, 9)
    assert re.search(r"\b8 .*\b26 ", published.note or "")
    assert select_layers(None, 3, "pi05").blocks == (0, 1, 2)
    with pytest.raises(BadArgument, match="0 to 27"):
        select_layers([28], 28, "cosmos")


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"name": "state"}, "'state'"),
        ({"name": "a/b"}, "'a/b'"),
        ({"layers": (3, 1)}, "3, 1"),
        ({"layers": (-1,)}, "-1"),
        ({"heads": -1}, "-1"),
        ({"spans": (span("a", 0, 2, growing=True), span("b", 2, 3, growing=True))}, "a, b"),
    ],
)
def test_a_site_has_a_name_of_its_own_and_numbers_that_can_be(changes, named):
    with pytest.raises(BadArgument, match=named):
        SiteLayout(**{"name": "even", "spans": (span("a", 0, 2),), **changes})


def test_what_is_recorded_of_a_site():
    recording = Recording((0, 1, 2, 5), (0, 1, 2, 5), (0,), (0, 1, 3), "all", 4, 10)
    everything = SiteLayout("joint", (span("a", 0, 2),))
    assert recording.of_site(everything) is recording
    own = recording.of_site(SiteLayout("odd", (span("a", 0, 2),), layers=(1, 3, 5), heads=2, num_action_queries=1))
    assert (own.layers, own.layer_labels, own.heads, own.num_queries) == ((1, 5), (1, 5), (0, 1), 1)
    with pytest.raises(BadArgument, match=r"'far'.* 0, 1, 2, 5; .* 7"):
        recording.of_site(SiteLayout("far", (span("a", 0, 2),), layers=(7,)))
    with pytest.raises(BadArgument, match=r"'few'.* 3; .*0 to 1"):
        Recording((0,), (0,), (0,), (3,), "all", 4, 10).of_site(SiteLayout("few", (span("a", 0, 2),), heads=2))
