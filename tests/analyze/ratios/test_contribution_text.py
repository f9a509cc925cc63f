"""A block that is named twice counts once in the average of contributions over layers."""

from __future__ import annotations

import numpy as np
import pytest

from tests.kit.made_up_steps import flat
from tests.kit.questions import question_about
from vla_attention.analyze.measures.frames import Tables
from vla_attention.analyze.measures.group_contributions import group_contribution_tables
from vla_attention.analyze.measures.question import Question
from vla_attention.analyze.measures.selected import resolve_all
from vla_attention.analyze.ratios.contribution_text import (
    group_contribution_sections,
)
from vla_attention.analyze.show.answer import text_of
from vla_attention.analyze.statistics.episode_intervals import Sampling
from vla_attention.schemas.groupings.grouping import Grouping, Ratio
from vla_attention.testing.stores import StoreSpec, write_store


def grouping_of(ratio: Ratio | None = None, **groups: tuple[str, ...]) -> Grouping:
    return Grouping("g", groups, ratio, overlap=True, allow_empty=tuple(groups))


def tables_of(question: Question) -> Tables | None:
    return group_contribution_tables(question, resolve_all(question.grouping, question.selected))


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
