"""The summary's sections on contribution norms: a line per layer, intervals, and a note on groups without a norm."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tests.kit.made_up_steps import flat
from tests.kit.questions import question_about
from vla_attention.analyze.measures.frames import Tables
from vla_attention.analyze.measures.group_contributions import group_contribution_tables
from vla_attention.analyze.measures.question import Question
from vla_attention.analyze.measures.selected import resolve_all
from vla_attention.analyze.ratios.analysis import analyse
from vla_attention.analyze.ratios.contribution_text import (
    contribution_sections,
    group_contribution_sections,
    same_sides,
)
from vla_attention.analyze.show.answer import text_of
from vla_attention.analyze.statistics.episode_intervals import Sampling
from vla_attention.schemas.groupings.grouping import Grouping, Ratio
from vla_attention.testing.stores import StoreSpec, write_store

SPEC = StoreSpec(contributions=True, replans=3, tasks=(0, 1), episodes=2)


@pytest.fixture(scope="module")
def store(tmp_path_factory) -> Path:
    return write_store(tmp_path_factory.mktemp("contributions") / "a.zarr", spec=SPEC)


def grouping_of(ratio: Ratio | None = None, **groups: tuple[str, ...]) -> Grouping:
    return Grouping("g", groups, ratio, overlap=True, allow_empty=tuple(groups))


def tables_of(question: Question) -> Tables | None:
    return group_contribution_tables(question, resolve_all(question.grouping, question.selected))


def test_the_summary_has_a_line_per_layer_and_an_interval(store):
    analysis = analyse(question_about(store, "objects"))  # cut segments, and have no norms
    assert analysis.contribution_rows is not None
    section = text_of(contribution_sections(analysis.contribution_rows))
    assert section in analysis.summary
    assert analysis.summary.count("CONTRIBUTIONS") == 1
    lines = [line.split() for line in section.splitlines()]
    assert [line[0] for line in lines if line and line[0] in ("0", "2", "layers_avg")] == ["0", "2", "layers_avg"]
    assert all("[" in " ".join(line) for line in lines if line and line[0] in ("0", "2", "layers_avg"))
    assert max(map(len, section.splitlines())) <= 100
    for name in ("ratio", "of means", "uniform", "lift"):
        assert name in section


def test_groups_that_are_both_sides_have_their_ratio_once(store):
    analysis = analyse(question_about(store))
    assert same_sides(analysis.contributions, analysis.group_contributions)
    assert analysis.summary.count("CONTRIBUTIONS") == 1
    assert "CONTRIBUTIONS OF GROUPS" in analysis.summary
    assert "root mean square over action queries" in " ".join(analysis.summary.split())
    # Six groups and the ratio do not fit beside one another: the ratio stands below.
    assert max(map(len, analysis.summary.splitlines())) <= 100
    section = analysis.summary.split("CONTRIBUTIONS OF GROUPS")[1]
    assert section.count("layers_avg") == 2


def test_a_store_without_contributions_has_no_section(tmp_path):
    analysis = analyse(question_about(write_store(tmp_path / "a.zarr")))
    assert analysis.contributions is None
    assert analysis.group_contributions is None
    assert "CONTRIBUTIONS" not in analysis.summary


def test_a_block_that_is_named_twice_counts_once_in_the_average_over_layers(tmp_path):
    spec = StoreSpec(
        contributions=True,
        layers=(0, 2),
        layer_labels=(0, 2, 4),
        denoise_steps=(0, 4, 9),
        queries="all",
        episodes=1,
    )
    ratio = Ratio(("images",), ("instruction",))
    question = question_about(
        write_store(tmp_path / "a.zarr", spec=spec),
        grouping_of(ratio, images=("role:image",), instruction=("role:instruction",), bowl=("word:the",)),
    )
    tables = tables_of(question)
    assert tables is not None
    table = flat(tables)
    assert table["layer"].unique().sort().to_list() == [0, 2, 4]
    text = text_of(group_contribution_sections(tables, question.grouping, "joint", Sampling()))
    lines = {line.split()[0]: line.split() for line in text.splitlines() if line[:1].strip()}
    means = {layer: table.filter(layer=layer)["images_norm"].mean() for layer in (0, 2)}
    # Episodes have as many replans each, so that the mean over episodes is that over rows.
    assert float(lines["layers_avg"][1]) == pytest.approx((means[0] + means[2]) / 2, rel=1e-3)
    assert lines["4"][1] == lines["0"][1]
    ratios = {layer: table.filter(layer=layer)["contribution_ratio"].log().mean() for layer in (0, 2)}
    assert float(lines["layers_avg"][3]) == pytest.approx(np.exp((ratios[0] + ratios[2]) / 2), rel=1e-3)
    assert "Not of bowl" in " ".join(text.split())
    assert max(map(len, text.splitlines())) <= 100


def test_a_group_without_keys_is_named_and_has_no_column(store):
    grouping = grouping_of(images=("role:image",), nothing=("span:right_wrist_0_rgb & role:image",))
    tables = tables_of(question_about(store, grouping))
    text = text_of(group_contribution_sections(tables, grouping, "joint", Sampling()))
    assert "The keys of nothing add exactly nothing." in text
    assert "|images|" in text
    assert "|nothing|" not in text


def test_when_every_group_is_cut_the_summary_says_why(store):
    question = question_about(store, grouping_of(word=("word:the",)))
    assert tables_of(question) is None
    text = text_of(group_contribution_sections(None, question.grouping, "joint", Sampling()))
    assert "Not of word: contributions are stored for whole segments" in text
