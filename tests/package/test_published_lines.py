"""Every published command line runs as typed, and says nothing new: the kept list, read by the parsers of today."""

from __future__ import annotations

import warnings

import pytest

from tests.kit.golden_tables import PUBLISHED_LINES as LINES
from tests.kit.golden_tables import parsed
from vla_attention.schemas.errors import Note


@pytest.mark.parametrize("words", LINES, ids=lambda words: " ".join(words)[:60])
def test_a_published_line_is_read_and_nothing_is_said(words, capsys):
    with warnings.catch_warnings():
        warnings.simplefilter("error", Note)
        parsed(words)
    assert capsys.readouterr() == ("", "")


def test_what_a_published_line_says_is_what_is_run():
    arguments = parsed(LINES[2])
    assert (arguments.task_suite, arguments.task_id, arguments.layers) == ("libero_spatial", [5], [17, 25, 26, 27])
    assert arguments.num_episodes == 10
    assert str(parsed(LINES[0]).output_dir) == "results/attention_ratio"
    of_make = parsed(LINES[-2])
    assert (of_make.task_suite, of_make.task_id, of_make.max_steps) == ("libero_10", [0], 40)
    assert str(of_make.store).endswith(".zarr")
