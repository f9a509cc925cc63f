"""What a request may name, and which bytes it may ask for."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from vla_attention.analyze.view.paths import (
    BadRange,
    NothingThere,
    Wanted,
    WrongToken,
    byte_range,
    is_allowed,
    wanted,
)


def test_the_page_its_documents_and_the_files_of_stores_are_named():
    assert wanted("/token/", "token", 1) == wanted("/token/index.html?episode=a", "token", 1) == Wanted("index.html")
    assert wanted("/token/stores.json", "token", 1) == Wanted(document=True)
    assert wanted("/token/stores/1.summary.json", "token", 2) == Wanted(summary=1)
    file = "episodes/task000_episode000/frames/base%200/c.0"
    assert wanted(f"/token/stores/0/{file}", "token", 1) == Wanted(
        store=0, file="episodes/task000_episode000/frames/base 0/c.0"
    )


@pytest.mark.parametrize(
    "path",
    [
        ".",
        "stores/0/episodes/..",
        "stores/0/episodes/../../x",
        "stores/0/episodes/..%2f..%2fx",
        "stores/0/episodes%2fa",
        "stores/0/episodes/a\\..\\x",
        "stores/0//etc/passwd",
        "stores/0/episodes//x",
        "stores/0/zarr.json%00.html",
        "stores/0/episodes/%ff%fe",
        "stores/0/episodes/\u202e".encode().decode("latin-1"),
        "stores/0",
        "stores/0/notes.txt",
        "stores/1/zarr.json",
        "stores/1.summary.json",
        "build.json",
        "a" * 5000,
    ],
)
def test_everything_else_is_nothing(path):
    with pytest.raises(NothingThere):
        wanted(f"/token/{path}", "token", 1)


def test_a_proxy_may_put_its_own_path_before_the_token():
    assert wanted("/user/me/proxy/absolute/8765/token/stores.json", "token", 1) == Wanted(document=True)


@pytest.mark.parametrize(
    "target",
    [
        "",
        "/",
        "/a//token/",
        "/a/tokens/stores.json",
        "/a/%74oken/",
        "token/",
        "/toke/",
        "/tokens/",
        "//token/",
        "/Token/",
        "/%74oken/",
        "/tökén/",
    ],
)
def test_a_target_without_the_whole_token_is_refused(target):
    with pytest.raises(WrongToken):
        wanted(target, "token", 1)


@given(st.text(st.sampled_from("./%2eEfF5c\\ab0"), max_size=30))
def test_no_path_leads_out_of_a_store(rest):
    try:
        found = wanted(f"/token/stores/0/episodes/{rest}", "token", 1)
    except NothingThere:
        return
    parts = found.file.split("/")
    assert parts[0] == "episodes"
    assert not {"", ".", ".."} & set(parts)
    assert "\\" not in found.file


@pytest.mark.parametrize("host", ["127.0.0.1", "127.0.0.1:80", "localhost:8765", "LOCALHOST", "[::1]:8765"])
def test_hosts_of_the_loopback_are_let_in(host):
    assert is_allowed(host)


@pytest.mark.parametrize(
    "host",
    [
        "",
        "evil.example",
        "127.0.0.1.evil.example",
        "127.0.0.1:80@evil.example",
        "localhost:80 ",
        "127.0.0.1,evil.example",
    ],
)
def test_other_hosts_are_not(host):
    assert not is_allowed(host)


@pytest.mark.parametrize(
    ("header", "expected"),
    [
        ("bytes=0-9", (0, 10)),
        ("bytes=-7", (93, 100)),
        ("bytes=10-99999999999999999", (10, 100)),
        (None, None),
        ("bytes=0-1,5-6", None),
        ("bytes=9-3", None),
        ("bytes=a-b", None),
        ("bytes=٣-٤", None),
    ],
)
def test_ranges(header, expected):
    assert byte_range(header, 100) == expected


@pytest.mark.parametrize("header", ["bytes=100-", "bytes=100-200", "bytes=-0"])
def test_ranges_without_a_byte(header):
    with pytest.raises(BadRange):
        byte_range(header, 100)
    with pytest.raises(BadRange):
        byte_range("bytes=0-", 0)


@given(st.binary(max_size=40), st.integers(0, 50), st.integers(0, 50))
def test_a_range_is_pythons_slice(content, first, last):
    try:
        found = byte_range(f"bytes={first}-{last}", len(content))
    except BadRange:
        assert first >= len(content)
        return
    if last < first:
        assert found is None
    else:
        assert content[slice(*found)] == content[first : last + 1]
