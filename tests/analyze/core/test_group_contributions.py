"""Norms of groups' contributions against the vectors of the Gram matrices: segments whole or cut, unions."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import polars as pl
import pytest

from tests.kit.questions import question_about
from tests.kit.stores import StoreSpec, contribution_vectors, write_store
from tests.kit.tokens import small_tokens
from vla_attention.analyze.core.contributions import group_norms, whole_segments
from vla_attention.analyze.measures.question import Question
from vla_attention.schemas.groupings.grouping import Grouping, Ratio
from vla_attention.schemas.groupings.resolve import ResolvedGrouping
from vla_attention.schemas.segments import Segment, segments_of

SPEC = StoreSpec(contributions=True, layers=(0, 2, 3), denoise_steps=(0, 4, 9), queries="all")
GROUPS = {
    "images": ("role:image",),
    "instruction": ("role:instruction",),
    "digits": ("role:state",),
    "bowl": ("word:put",),
    "patches": ("patch:base_0_rgb[0:1,0:4]",),
    "bowl_seen": ("object:akita_black_bowl_1",),
    "nothing": ("span:right_wrist_0_rgb & role:image",),
    "all_text": ("span:prompt",),
}
#: The groups above that take segments whole, and which.
WHOLE = {
    "images": lambda segment: segment.role == "image",
    "instruction": lambda segment: segment.role == "instruction",
    "digits": lambda segment: segment.role == "state",
    "nothing": lambda segment: False,
    "all_text": lambda segment: segment.span == "prompt",
}


def grouping_of(ratio: Ratio | None = None, **groups) -> Grouping:
    every = groups or GROUPS
    return Grouping("g", every, ratio, overlap=True, allow_empty=tuple(every))


def table_of(question: Question) -> pl.DataFrame | None:
    norms = group_norms(question)
    if norms is None:
        return None
    cells = norms.cells().collect()
    named = norms.norms().collect().partition_by("group", as_dict=True, maintain_order=True)
    return cells.with_columns(table["norm"].alias(f"{name}_norm") for (name,), table in named.items())


def norm_by_hand(spec: StoreSpec, row: dict, chosen, layer: int, denoise: int) -> float:
    """Root mean square over the queries of the length of the chosen segments' summed vectors."""
    seed = [spec.seed, row["task_id"], row["episode_index"]]
    tokens = small_tokens(spec.replans, row["task_id"], seed, changing=spec.prompts == "changing")
    segments: tuple[Segment, ...] = segments_of(tokens.layout, tokens.key_role[row["replan"]])
    vectors = contribution_vectors(spec, tokens, seed, row["replan"])[layer, denoise]
    summed = vectors[:, [bool(chosen(segment)) for segment in segments]].sum(axis=1)
    return float(np.sqrt((summed**2).sum(axis=1).mean()))


@pytest.fixture(scope="module")
def store(tmp_path_factory) -> Path:
    return write_store(tmp_path_factory.mktemp("contributions") / "a.zarr", spec=SPEC)


def test_norms_of_whole_groups_are_those_of_summed_vectors_and_cut_groups_are_left_out(store):
    question = question_about(store, grouping_of(), layers=(3, 0), denoise=("9", "0"))
    table = table_of(question)
    assert table is not None
    assert [name for name in table.columns if name.endswith("_norm")] == [
        f"{name}_norm" for name in GROUPS if name in WHOLE
    ]
    assert table.height == 4 * SPEC.replans * 2 * 2
    assert table.select("block", "denoise_step").head(4).rows() == [(3, 9), (3, 0), (0, 9), (0, 0)]
    for row in table.iter_rows(named=True):
        at = SPEC.layers.index(row["block"]), SPEC.denoise_steps.index(row["denoise_step"])
        assert row["env_step"] == 10 + 5 * row["replan"]
        for name, chosen in WHOLE.items():
            assert row[f"{name}_norm"] == pytest.approx(norm_by_hand(SPEC, row, chosen, *at), rel=1e-4, abs=1e-6)


def test_the_ratio_is_of_vector_sums_and_not_of_summed_lengths(store):
    ratio = Ratio(("images", "digits"), ("instruction",))
    question = question_about(
        store, grouping_of(ratio, **{name: GROUPS[name] for name in ("images", "digits", "instruction")})
    )
    table = table_of(question)
    assert table is not None
    differs = 0
    for row in table.head(40).iter_rows(named=True):
        at = SPEC.layers.index(row["block"]), SPEC.denoise_steps.index(row["denoise_step"])
        above = norm_by_hand(SPEC, row, lambda segment: segment.role in ("image", "state"), *at)
        below = norm_by_hand(SPEC, row, WHOLE["instruction"], *at)
        assert row["numerator_norm"] == pytest.approx(above, rel=1e-4)
        assert row["contribution_ratio"] == pytest.approx(above / below, rel=1e-4)
        differs += abs(row["images_norm"] + row["digits_norm"] - above) > 0.1
    assert differs > 20


def test_a_ratio_with_a_side_that_is_cut_or_empty_is_no_number(store):
    cut = table_of(question_about(store, grouping_of(Ratio(("images",), ("bowl",)))))
    assert cut is not None
    assert "contribution_ratio" not in cut.columns
    assert "images_norm" in cut.columns
    over_nothing = table_of(question_about(store, grouping_of(Ratio(("images",), ("nothing",)))))
    assert over_nothing is not None
    assert over_nothing["contribution_ratio"].is_infinite().all()
    undefined = table_of(question_about(store, grouping_of(Ratio(("nothing",), ("nothing",)))))
    assert undefined is not None
    assert undefined["contribution_ratio"].is_null().all()


@pytest.mark.parametrize(("weight", "replans", "kept"), [(1.0, 3, True), (0.5, 3, False), (1.0, 1, False)])
def test_a_segment_is_taken_whole_always_or_not_at_all(store, weight, replans, kept):
    """A half of every key is no whole segment, and neither are all keys at some replans only."""
    item = question_about(store).selected[0]
    weights = np.zeros((item.tokens.num_replans, item.tokens.layout.num_keys, 1), dtype=np.float32)
    (span,) = item.tokens.layout.camera_spans("base_0_rgb")
    weights[:replans, span.start : span.stop, 0] = weight
    resolved = ResolvedGrouping(("g",), weights, weights.sum(axis=1, dtype=np.float64), item.valid.sum(axis=1))
    parts = whole_segments(item, resolved, "joint")
    assert set(parts) == ({"g"} if kept else set())
    if kept:
        assert np.flatnonzero(parts["g"]).tolist() == [0]


def test_only_groups_that_are_whole_in_every_episode_are_measured(tmp_path):
    path = write_store(tmp_path / "a.zarr", spec=replace(SPEC, episodes=1, replans=1))
    # Task 1 says "open the top drawer": there, the phrase takes its segment whole.
    # In task 0 no key is taken, which counts as whole, too.
    whole = grouping_of(phrase=('word:"open the top drawer"',), rest=("*",))
    table = table_of(question_about(path, whole))
    assert table is not None
    assert table.filter(task_id=0)["phrase_norm"].max() == 0.0
    assert table.filter(task_id=1)["phrase_norm"].min() > 0.0
    part = grouping_of(word=("word:the",), images=("role:image",))
    measured = table_of(question_about(path, part))
    assert measured is not None
    assert "word_norm" not in measured.columns
    assert table_of(question_about(path, grouping_of(word=("word:the",)))) is None
