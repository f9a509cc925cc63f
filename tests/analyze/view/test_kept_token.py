"""The viewer's link: the same after a restart, secret before and after, and of this user's own files only."""

from __future__ import annotations

import os
import re
import stat
from pathlib import Path

import pytest

from tests.kit.stores import StoreSpec, write_store
from vla_attention.analyze.view import kept_token as module
from vla_attention.analyze.view.kept_token import kept_token
from vla_attention.analyze.view.served_stores import ServedStore
from vla_attention.analyze.view.server import ViewerServer
from vla_attention.analyze.view.summaries import Summary
from vla_attention.schemas.stores.reader import open_store
from vla_attention.schemas.stores.store_url import StoreUrl

PLACES = (Path("/runs/a.zarr"), StoreUrl("hf://datasets/a/b@0123/c.zarr"))


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch) -> Path:
    """The folder of the links, of a user without any."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return tmp_path / "cache/vla-attention/links"


def kept(folder: Path) -> Path:
    """The only file."""
    (path,) = folder.iterdir()
    return path


def test_a_restart_on_the_same_port_has_the_same_link(tmp_path):
    store = write_store(tmp_path / "a.zarr", spec=StoreSpec(tasks=(0,), episodes=1))
    links, port = [], 0
    for keep_link in (True, True, False, True):
        stores = [ServedStore(open_store(store), Summary())]
        with ViewerServer(stores, port, keep_link=keep_link) as server:
            links.append(server.link)
            assert server.keeps_link == keep_link
            port = server.port
    assert links[0] == links[1] == links[3] != links[2]


def test_other_ports_stores_and_orders_have_other_tokens():
    asked = [(PLACES, 8001), (PLACES, 8002), (PLACES[:1], 8001), (PLACES[::-1], 8001)]
    first = [kept_token(*each) for each in asked]
    assert len(set(first)) == len(first)
    assert [kept_token(*each) for each in asked] == first
    assert all(re.fullmatch(r"[\w-]{32}", token or "") for token in first)


def test_nobody_else_can_read_it(folder):
    before = os.umask(0)
    try:
        token = kept_token(PLACES, 8001)
    finally:
        os.umask(before)
    assert stat.S_IMODE(folder.stat().st_mode) == 0o700
    assert stat.S_IMODE(kept(folder).stat().st_mode) == 0o600
    assert kept(folder).read_text() == token
    # Its name says neither the token nor the store.
    assert re.fullmatch(r"[0-9a-f]{64}", kept(folder).name)


@pytest.mark.parametrize("mode", [0o640, 0o602])
def test_a_file_that_others_can_use_is_replaced(folder, mode):
    first = kept_token(PLACES, 8001)
    kept(folder).chmod(mode)
    second = kept_token(PLACES, 8001)
    assert second not in (None, first)
    assert stat.S_IMODE(kept(folder).stat().st_mode) == 0o600
    assert kept_token(PLACES, 8001) == second


def test_a_file_of_somebody_else_is_replaced(folder, monkeypatch):
    first = kept_token(PLACES, 8001)
    real = os.fstat

    def of_somebody_else(handle: int) -> os.stat_result:
        status = real(handle)
        return os.stat_result([*status[:4], status.st_uid + 1, *status[5:]])

    with monkeypatch.context() as patch:
        patch.setattr(module.os, "fstat", of_somebody_else)
        assert kept_token(PLACES, 8001) != first
    assert kept(folder).read_text() != first


@pytest.mark.parametrize("kind", ["link", "fifo", "folder"])
def test_what_is_no_file_is_not_read(folder, tmp_path, kind):
    first = kept_token(PLACES, 8001)
    path = kept(folder)
    elsewhere = tmp_path / "mine"
    path.rename(elsewhere)
    if kind == "link":
        path.symlink_to(elsewhere)
    elif kind == "fifo":
        os.mkfifo(path)
    else:
        path.mkdir()
    second = kept_token(PLACES, 8001)
    assert second != first
    assert (second is None) == (kind == "folder")
    assert elsewhere.read_text() == first  # what a link leads to is not written either


@pytest.mark.parametrize("kind", ["others write", "link", "file above it", "file in its place"])
def test_a_folder_that_is_not_this_users_alone_keeps_nothing(folder, tmp_path, kind):
    if kind == "others write":
        folder.mkdir(parents=True)
        folder.chmod(0o770)
    elif kind == "link":
        folder.parent.mkdir(parents=True)
        (tmp_path / "elsewhere").mkdir(mode=0o700)
        folder.symlink_to(tmp_path / "elsewhere")
    else:
        (folder.parent if kind == "file in its place" else folder.parent.parent).mkdir(parents=True)
        (folder if kind == "file in its place" else folder.parent).write_text("mine")
    assert kept_token(PLACES, 8001) is None
    if folder.is_dir():
        assert not list(folder.iterdir())
    with ViewerServer((), keep_link=True) as server:
        assert not server.keeps_link
        assert re.fullmatch(r"[\w-]{32}", server.token)
