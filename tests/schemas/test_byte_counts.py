"""Sizes as people write them."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from vla_attention.schemas.byte_counts import parse_bytes
from vla_attention.schemas.errors import BadArgument
from vla_attention.schemas.stores.remote_source import kept_bytes


@pytest.mark.parametrize(
    ("text", "expected"),
    [("0", 0), ("20GB", 20e9), (" 1.5tb ", 1.5e12), ("500 MiB", 500 * 2**20), (".5 k", 500), ("2.", 2), ("3b", 3)],
)
def test_sizes_are_read(text, expected):
    assert parse_bytes(text) == expected


@pytest.mark.parametrize("text", ["", "GB", "1 PB", "-1", "1,5GB", "1e9", "nan", "inf", "9" * 400, "9" * 400 + "TB"])
def test_what_is_no_size_gives_nothing(text):
    assert parse_bytes(text) is None


@given(st.text(alphabet="0123456789.kMGTiB -e\u0663", max_size=30))
def test_any_text_gives_a_size_or_nothing(text):
    found = parse_bytes(text)
    assert found is None or 0 <= found < 10**15 * 2**40


@pytest.mark.parametrize("text", ["inf", "much", "-1", "9" * 400])
def test_the_size_of_what_is_kept_of_remote_stores(text, monkeypatch):
    monkeypatch.setenv("VLA_REMOTE_CACHE", "on-disk")
    monkeypatch.setenv("VLA_REMOTE_CACHE_SIZE", "3GB")
    kept = kept_bytes()
    assert kept is not None
    assert kept.most_bytes == 3_000_000_000
    monkeypatch.setenv("VLA_REMOTE_CACHE_SIZE", text)
    with pytest.raises(BadArgument, match=r"^VLA_REMOTE_CACHE_SIZE=.* is no size; expected"):
        kept_bytes()
