"""What is said before a download from the hub."""

import sys
import types

import pytest

from vla_attention.schemas.hub import say_download

SIZES = {"data/a.parquet": 40_000_000, "videos/b.mp4": 1_200_000_000, "videos/c.mp4": 300_000_000}


@pytest.fixture
def hub(monkeypatch):
    """A client that knows the sizes of three files, of which one is in the cache; what it was asked."""
    asked = []

    class HfApi:
        def get_paths_info(self, repository, paths, *, revision, repo_type):
            asked.append((repository, tuple(paths), revision, repo_type))
            return [types.SimpleNamespace(path=path, size=SIZES[path]) for path in paths]

    def in_cache(repository, path, *, revision, repo_type):
        return "/cache/c.mp4" if path == "videos/c.mp4" else None

    client = types.SimpleNamespace(HfApi=HfApi, try_to_load_from_cache=in_cache)
    monkeypatch.setitem(sys.modules, "huggingface_hub", client)
    return asked


def test_the_gigabytes_that_are_missing_are_said(hub, capsys, monkeypatch, tmp_path):
    monkeypatch.setenv("HF_HUB_CACHE", str(tmp_path))
    say_download("org/set", list(SIZES), "dataset", "abc")
    said = capsys.readouterr().err
    assert "2 files, 1.2 GB, of org/set" in said
    assert str(tmp_path) in said
    assert hub == [("org/set", ("data/a.parquet", "videos/b.mp4"), "abc", "dataset")]


def test_little_and_nothing_are_not_worth_a_line(hub, capsys):
    say_download("org/set", ["data/a.parquet", "videos/c.mp4"], "dataset", None)
    say_download("org/set", ["videos/c.mp4"], "dataset", None)
    say_download("org/set", ["gone.mp4"], "dataset", None)  # the download says what is wrong
    assert capsys.readouterr().err == ""
