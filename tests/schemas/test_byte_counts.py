"""Sizes as people write them."""

from __future__ import annotations

import pytest

from vla_attention.schemas.byte_counts import parse_bytes


@pytest.mark.parametrize(
    ("text", "expected"),
    [("0", 0), ("20GB", 20e9), (" 1.5tb ", 1.5e12), ("500 MiB", 500 * 2**20), (".5 k", 500), ("2.", 2), ("3b", 3)],
)
def test_sizes_are_read(text, expected):
    assert parse_bytes(text) == expected


@pytest.mark.parametrize("text", ["", "GB", "1 PB", "-1", "1,5GB", "1e9", "nan", "inf", "9" * 400, "9" * 400 + "TB"])
def test_what_is_no_size_gives_nothing(text):
    assert parse_bytes(text) is None
