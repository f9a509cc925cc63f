"""Files from anybody are opened only if they are files, and where they seem to be."""

from __future__ import annotations

import os
import socket
from pathlib import Path

import numpy as np
import pytest

from vla_attention.schemas.regular_files import NotRegular, open_regular, read_regular
from vla_attention.schemas.stores.byte_source import Folder


def test_a_file_is_read_whole(tmp_path):
    for size in (0, 1, 100_000):
        (tmp_path / "a").write_bytes(bytes(size))
        assert read_regular(tmp_path / "a", size) == bytes(size)
    with pytest.raises(NotRegular, match="100,000 bytes; expected at most 99,999"):
        read_regular(tmp_path / "a", 99_999)


def test_what_is_no_file(tmp_path, monkeypatch):
    os.mkfifo(tmp_path / "fifo")
    (tmp_path / "folder").mkdir()
    (tmp_path / "link").symlink_to("folder")
    monkeypatch.chdir(tmp_path)  # an address of a socket is short
    with socket.socket(socket.AF_UNIX) as bound:
        bound.bind("socket")
        for name, said in (("fifo", "a FIFO"), ("folder", "a folder"), ("link", "a folder"), ("socket", "a socket")):
            with pytest.raises(NotRegular, match=f"it is {said} and no regular file"):
                open_regular(tmp_path / name)
    with pytest.raises(NotRegular, match="it is a device"):
        open_regular("/dev/null")
    with pytest.raises(NotRegular, match="it is a link"):
        open_regular(tmp_path / "link", follow=False)
    with pytest.raises(FileNotFoundError):
        open_regular(tmp_path / "nothing")


def test_holes_are_not_read(tmp_path):
    for name, content in (("holes", b"x"), ("nothing", b""), ("full", bytes(range(256)) * 400_000)):
        with (tmp_path / name).open("wb") as file:
            file.write(content)
            file.truncate(102_400_000)
    files = Folder(tmp_path)
    for name in ("holes", "nothing"):
        with pytest.raises(NotRegular, match=r"102,400,000 bytes, of which .* are stored and the others are holes"):
            files.whole(name)
    assert len(files.whole("full")) == 102_400_000


def store_with_links(folder: Path) -> Path:
    """A store in which links lead to other places in it, and a file beside it."""
    store = folder / "a.zarr"
    (store / "episodes/one/joint").mkdir(parents=True)
    (store / "episodes/one/joint/c").write_bytes(b"content")
    (store / "episodes/one/again").symlink_to("joint")
    (store / "episodes/one/c").symlink_to("joint/c")
    (store / "episodes/two").symlink_to("one")
    (folder / "outside").mkdir()
    (folder / "outside/c").write_bytes(b"outside")
    return store


def test_links_inside_of_a_store_are_followed_and_others_refused(tmp_path):
    store = store_with_links(tmp_path)
    (tmp_path / "link.zarr").symlink_to(store)
    for root in (store, tmp_path / "link.zarr"):
        for episode in ("one", "two"):
            files = Folder(root / "episodes" / episode, within=root)
            for file in ("joint/c", "again/c", "c"):
                assert files.whole(file) == b"content"
                assert (files.part(file, 2, 3), files.part(file, 5, 9)) == (b"nte", b"nt")
                assert files.size(file) == 7
    (store / "episodes/one/out").symlink_to(tmp_path / "outside")
    (store / "episodes/one/out_c").symlink_to("../../../outside/c")
    (store / "episodes/three").symlink_to(tmp_path / "outside")
    memory = np.empty(3, np.uint8)
    for episode, file in (("one", "out/c"), ("one", "out_c"), ("three", "c")):
        files = Folder(store / "episodes" / episode, within=store)
        for read in (files.whole, files.size, lambda f, at=files: at.part(f, 0, 3)):
            with pytest.raises(NotRegular, match="it is a link that leads out of the store"):
                read(file)
        with pytest.raises(NotRegular, match="it is a link that leads out of the store"):
            files.read_into(memory, file, 0)
