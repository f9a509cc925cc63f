"""Files that are opened: regular ones, inside of their folder, or a blob of the same repository in the hub's cache."""

from __future__ import annotations

import os
import socket

import pytest

from vla_attention.schemas.checked_files import check_folder, check_regular
from vla_attention.schemas.errors import BadArgument


@pytest.fixture
def file(tmp_path):
    path = tmp_path / "folder" / "file"
    path.parent.mkdir()
    path.write_bytes(b"12345")
    return path


def test_a_link_out_of_the_folder_is_the_user_s_only_where_it_was_named(file, tmp_path):
    link = tmp_path / "other" / "link"
    link.parent.mkdir()
    link.symlink_to(file)
    assert check_regular(link, BadArgument) == 5
    for check in (
        lambda: check_regular(link, BadArgument, inside=link.parent),
        lambda: check_folder(link.parent, BadArgument),
    ):
        with pytest.raises(BadArgument, match=r"/link' .*/file'"):
            check()
    check_folder(link.parent, BadArgument, inside=False)


def test_the_hub_s_cache_has_links_to_blobs_of_the_same_repository(tmp_path):
    for name in ("models--a--b", "models--c--d"):
        (tmp_path / name / "blobs").mkdir(parents=True)
        (tmp_path / name / "blobs" / "1").write_bytes(b"1")
    snapshot = tmp_path / "models--a--b" / "snapshots" / "x" / "tokenizer"
    snapshot.mkdir(parents=True)
    (snapshot / "own").symlink_to("../../../blobs/1")
    (snapshot / "other").symlink_to("../../../../models--c--d/blobs/1")
    assert check_regular(snapshot / "own", BadArgument, inside=snapshot) == 1
    with pytest.raises(BadArgument, match="other"):
        check_regular(snapshot / "other", BadArgument, inside=snapshot)


def test_what_is_no_file(file, tmp_path):
    os.mkfifo(tmp_path / "pipe")
    with socket.socket(socket.AF_UNIX) as server:
        server.bind(str(tmp_path / "socket"))
        for name in ("pipe", "socket", "folder"):
            with pytest.raises(BadArgument, match=name):
                check_regular(tmp_path / name, BadArgument)
    with pytest.raises(FileNotFoundError):
        check_regular(tmp_path / "nothing", BadArgument)
