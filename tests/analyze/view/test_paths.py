"""What a request may name."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from vla_attention.analyze.view.paths import (
    LOOPBACK_NAMES,
    NothingThere,
    WrongToken,
    name_of_host,
    wanted,
)


def test_the_page_and_answers_are_named():
    assert wanted("/token/", "token") == (["index.html"], {})
    assert wanted("/token/runs.json", "token") == (["runs.json"], {})
    assert wanted("/token/main.js?a=b", "token") == (["main.js"], {"a": ["b"]})
    asked = wanted("/token/runs/0/a/joint/keys.json?selector=word%3Ared+cube", "token")
    assert asked == (["runs", "0", "a", "joint", "keys.json"], {"selector": ["word:red cube"]})


@pytest.mark.parametrize(
    "path",
    [
        ".",
        "runs/0/..",
        "runs/0/../../x",
        "runs/0/..%2f..%2fx",
        "runs/0%2fa",
        "runs/0/a\\..\\x",
        "runs/0//etc/passwd",
        "runs/0/about.json%00.html",
        "runs/0/%ff%fe",
        "runs/0/\u202e".encode().decode("latin-1"),
        "stores/0/zarr.json",
        "build.json",
        "main.js/x",
        "a" * 5000,
    ],
)
def test_everything_else_is_nothing(path):
    with pytest.raises(NothingThere):
        wanted(f"/token/{path}", "token")


def test_a_proxy_may_put_its_own_path_before_the_token():
    assert wanted("/user/me/proxy/absolute/8765/token/runs.json", "token") == (["runs.json"], {})


@pytest.mark.parametrize(
    "target",
    [
        "",
        "/",
        "/a//token/",
        "/a/tokens/runs.json",
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
        wanted(target, "token")


@given(st.text(st.sampled_from("./%2eEfF5c\\ab0"), max_size=30))
def test_no_address_has_parts_that_lead_elsewhere(rest):
    try:
        names, _ = wanted(f"/token/runs/0/{rest}", "token")
    except NothingThere:
        return
    assert not {"", ".", ".."} & set(names)
    assert not any("/" in part or "\\" in part for part in names)


@pytest.mark.parametrize("host", ["127.0.0.1", "127.0.0.1:80", "localhost:8765", "LOCALHOST", "[::1]:8765"])
def test_hosts_of_the_loopback_are_let_in(host):
    assert name_of_host(host) in LOOPBACK_NAMES


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
    assert name_of_host(host) not in LOOPBACK_NAMES
