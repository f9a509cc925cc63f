"""What clicks make of a selector in the viewer's panel: the same selector more or less a part, in Python's reading."""

from __future__ import annotations

import itertools
import shlex
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tests.kit.grouping_cases import grouping_cases
from tests.kit.grouping_episodes import NUM_EPISODES, made_up_episode
from tests.kit.viewer_in_node import needs_node, run_in_node
from vla_attention.schemas.groupings.resolve import weights_of
from vla_attention.schemas.groupings.selector_parser import parse_selector
from vla_attention.schemas.groupings.selectors import SelectorError
from vla_attention.schemas.jsonable import to_json

pytestmark = needs_node


def readable_selectors(count: int) -> list[str]:
    """Selectors that can be read, of all kinds."""
    given = [text.partition("=")[2] for case in grouping_cases(count)["cases"] for text in case["groups"]]
    return [text for text in given if len(text) < 3000 and _can_be_read(text)]


def _can_be_read(text: str) -> bool:
    try:
        parse_selector(text)
    except SelectorError:
        return False
    return True


def rectangles_of(mask: NDArray[np.bool_]) -> list[tuple[int, int, int, int]]:
    rows, columns = mask.shape
    ends = [list(itertools.combinations(range(size + 1), 2)) for size in (rows, columns)]
    return [(r0, r1, c0, c1) for r0, r1 in ends[0] for c0, c1 in ends[1] if mask[r0:r1, c0:c1].all()]


def fewest_rectangles(mask: NDArray[np.bool_]) -> int:
    """How many rectangles a union must have at least, by trying all."""
    covers = []
    for r0, r1, c0, c1 in rectangles_of(mask):
        own = np.zeros_like(mask)
        own[r0:r1, c0:c1] = True
        covers.append(own)
    maximal = [
        own for own in covers if not any((own & ~other).sum() == 0 and other.sum() > own.sum() for other in covers)
    ]
    for number in range(len(maximal) + 1):
        for chosen in itertools.combinations(maximal, number):
            if (np.any(chosen, axis=0) == mask).all() if chosen else not mask.any():
                return number
    raise AssertionError("no union of rectangles is the mask")


def test_painted_patches_are_as_few_rectangles_as_possible(tmp_path):
    generator = np.random.default_rng(5)
    masks = [generator.random((4, 5)) < share for share in (0.0, 0.3, 0.5, 0.7, 0.9, 1.0) for _ in range(12)]
    frame = np.ones((16, 16), dtype=bool)
    frame[3:13, 2:14] = False
    masks += [frame, generator.random((16, 16)) < 0.5]
    given = [{"mask": mask.ravel().astype(int).tolist(), "rows": len(mask), "columns": mask.shape[1]} for mask in masks]
    found = run_in_node(tmp_path, {"rectangles": given})["rectangles"]
    for mask, rectangles in zip(masks, found, strict=True):
        union = np.zeros_like(mask)
        for one in rectangles:
            union[one["r0"] : one["r1"], one["c0"] : one["c1"]] = True
        assert (union == mask).all()
        if mask.size == 20:
            assert len(rectangles) == fewest_rectangles(mask), mask
    assert len(found[-2]) == 4


def test_a_selector_that_is_written_again_means_the_same(tmp_path):
    texts = readable_selectors(300)
    found = run_in_node(tmp_path, {"rewritten": texts})["rewritten"]
    assert len(texts) > 200
    assert [parse_selector(text) for text in found] == [parse_selector(text) for text in texts]


def test_a_click_adds_a_part_and_a_second_one_takes_it_out(tmp_path):
    texts = [text for text in readable_selectors(100) if text.count("(") < 50]
    atom = {"kind": "word", "argument": "it's new"}
    added = run_in_node(tmp_path, {"toggled": [{"text": text, "atom": atom} for text in texts]})["toggled"]
    assert [parse_selector(text) for text in added] == [
        parse_selector(f'({text}) | word:"it\'s new"') for text in texts
    ]
    left = run_in_node(tmp_path, {"toggled": [{"text": text, "atom": atom} for text in added]})["toggled"]
    assert [parse_selector(text) for text in left] == [parse_selector(text) for text in texts]
    unreadable = run_in_node(tmp_path, {"toggled": [{"text": "word:", "atom": atom}]})["toggled"]
    assert unreadable == [{"error": "Cannot read selector 'word:' at character 1: expected a name after 'word:'."}]


def test_strokes_paint_and_erase_patches_and_nothing_else(tmp_path):
    generator = np.random.default_rng(6)
    cases: list[dict[str, Any]] = []
    expected = []
    for number in range(NUM_EPISODES):
        tokens = made_up_episode(16, number)
        layout = tokens.layout
        span = next(span for span in layout.spans if span.grid is not None)
        assert span.grid is not None
        rows, columns = span.grid.rows, span.grid.columns
        old = f"{span.camera}[0:{rows},0:1]"
        others = f"role:action - keys:{span.start} | keys:{layout.num_keys - 1}"
        text = f'{others} | patch:"{old}"' if number % 2 else others
        patches = generator.integers(0, rows * columns, 3).tolist()
        erase = number % 4 == 3
        cases.append(
            {"text": text, "layout": to_json(layout), "camera": span.camera, "patches": patches, "erase": erase}
        )
        mask = np.zeros((rows, columns), dtype=bool)
        mask[:, 0] = number % 2 == 1
        mask.ravel()[patches] = not erase
        weights = weights_of(parse_selector(others), tokens).copy()
        weights[:, span.start : span.stop] = np.maximum(weights[:, span.start : span.stop], mask.ravel())
        expected.append((tokens, weights))
    found = run_in_node(tmp_path, {"painted": cases})["painted"]
    for text, (tokens, weights) in zip(found, expected, strict=True):
        assert (weights_of(parse_selector(text), tokens) == weights).all(), text


def test_links_keep_what_was_typed_and_commands_are_quoted_for_the_shell(tmp_path):
    drafts = [
        '@base cameras\n@ratio a,b/c\n@overlap\n@empty a\n@empty b\na = word:"x y" | keys:0-3\nnew = ',
        "@file mine\na = a = b\n@x = role:image",
        "",
    ]
    words = ["a", "a b", "it's", 'word:"a b"=x', "", "ä", "a|b", "$HOME", "a=b,c/d.e-f@g:h+i%j", "a\nb", "!", "*"]
    found = run_in_node(tmp_path, {"drafts": drafts, "shell": words})
    assert found["drafts"][0] == drafts[0]
    assert found["drafts"][2] == ""
    assert found["shell"] == [shlex.quote(word) for word in words]
