"""Uploading to the hub, with a client that keeps what it is given: nothing here has spoken to the real hub."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from vla_attention.analyze.__main__ import main as analyze
from vla_attention.analyze.copy import pushing
from vla_attention.schemas.stores.packed_index import INDEX_FILE
from vla_attention.schemas.stores.reader import open_store
from vla_attention.schemas.stores.verify import verify_store
from vla_attention.testing.stores import StoreSpec, write_store

SPEC = StoreSpec(tasks=(0, 1), episodes=2, replans=2)
ADDRESS = "hf://datasets/org/name/runs/a.zarr"


@dataclass
class Client:
    """What of `huggingface_hub` is used; `commits` are the files of each."""

    commits: list[dict[str, bytes]] = field(default_factory=list)
    created: list[str] = field(default_factory=list)
    there: set[str] = field(default_factory=set)
    refuses: bool = False

    def CommitOperationAdd(self, path_in_repo: str, path_or_fileobj: str | bytes) -> tuple[str, bytes]:
        content = path_or_fileobj if isinstance(path_or_fileobj, bytes) else Path(path_or_fileobj).read_bytes()
        return path_in_repo, content

    def HfApi(self) -> SimpleNamespace:
        return SimpleNamespace(
            create_repo=self.create_repo, create_commit=self.create_commit, file_exists=self.file_exists
        )

    def create_repo(self, repository: str, *, repo_type: str, exist_ok: bool) -> None:
        assert (repo_type, exist_ok) == ("dataset", True)
        self.created.append(repository)

    def file_exists(self, repository: str, file: str, *, repo_type: str, revision: str) -> bool:
        return file in self.there

    def create_commit(self, repository: str, operations: list[tuple[str, bytes]], **options: Any) -> None:
        assert options["repo_type"] == "dataset"
        if self.refuses:
            raise PermissionError("403 Forbidden\nmore lines")
        self.commits.append(dict(operations))


@pytest.fixture
def client(monkeypatch) -> Client:
    made = Client()
    monkeypatch.setattr(pushing, "_client", lambda: made)
    return made


@pytest.fixture(scope="module")
def store(tmp_path_factory) -> Path:
    return write_store(tmp_path_factory.mktemp("pushed") / "folder.zarr", spec=replace(SPEC, suite="a|b<i>"))


def test_what_is_uploaded_is_the_packed_store(store, client, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(pushing, "_FILES_A_COMMIT", 3)
    assert analyze(["copy", str(store), str(tmp_path / "a.zarr"), "--packed", "--push", ADDRESS]) == 0
    assert "4 episodes in 7 files" in capsys.readouterr().out
    assert client.created == ["org/name"]
    assert len(client.commits) == 3
    # The index comes last: nobody finds one of episodes that are not there yet.
    assert set(client.commits[-1]) == {f"runs/a.zarr/{INDEX_FILE}", "README.md"}
    for commit in client.commits:
        for name, content in commit.items():
            place = tmp_path / "got" / name
            place.parent.mkdir(parents=True, exist_ok=True)
            place.write_bytes(content)
    got = open_store(tmp_path / "got/runs/a.zarr")
    assert verify_store(got) == []
    assert [one.seal.digest for one in got.episodes] == [one.seal.digest for one in open_store(store).episodes]


def test_what_a_link_leads_to_is_not_uploaded(store, client, tmp_path, capsys):
    """A packed copy that came from somebody else, and is continued here."""
    packed, secret = tmp_path / "a.zarr", tmp_path / "secret"
    words = ["copy", str(store), str(packed), "--packed", "--push", ADDRESS]
    assert analyze(words[:-2]) == 0
    zipped = packed / "episodes/task000_000/task000_episode000.zip"
    secret.write_bytes(b"x" * zipped.stat().st_size)  # as many bytes as the index says
    for file in (zipped, packed / "episodes/zarr.json"):
        file.unlink()
        file.symlink_to(secret)
    assert analyze(words) == 2
    assert f"Cannot upload {packed}: episodes/zarr.json in it is a link" in capsys.readouterr().err
    assert not zipped.is_symlink()  # packed again
    assert not any(secret.read_bytes() in commit.values() for commit in client.commits)


def test_the_card_says_what_the_store_holds(store, client, tmp_path):
    assert analyze(["copy", str(store), str(tmp_path / "a.zarr"), "--packed", "--push", ADDRESS]) == 0
    card = client.commits[-1]["README.md"].decode()
    assert card.startswith("---\n")
    for text in (
        "4 episodes of 2 tasks",
        "8 replans",
        "UNTRAINED",
        f"vla-attention analyze {ADDRESS}",
        "| pictures | yes |",
    ):
        assert text in card, text
    assert "<i>" not in card.partition("\n---\n")[2]
    assert "suite a&#124;b&#60;i&#62;" in card


def test_a_card_that_is_there_stays(store, client, tmp_path, capsys):
    client.there = {"README.md"}
    assert analyze(["copy", str(store), str(tmp_path / "a.zarr"), "--packed", "--push", ADDRESS]) == 0
    assert set(client.commits[-1]) == {f"runs/a.zarr/{INDEX_FILE}"}
    assert "README.md is left as it was" in capsys.readouterr().out


def test_what_cannot_be_pushed_is_a_sentence(store, client, tmp_path, capsys):
    target = str(tmp_path / "a.zarr")
    for words, expected in (
        ([target, "--push", ADDRESS], "add --packed"),
        (["--packed", "--push", ADDRESS], "need a DEST"),
        ([target, "--packed", "--push", "s3://bucket/a.zarr"], "expected hf://datasets/ORG/NAME/FILE.zarr"),
        ([target, "--packed", "--push", "hf://org/name/a.zarr"], "expected hf://datasets/ORG/NAME/FILE.zarr"),
        ([target, "--packed", "--push", "hf://datasets/org/name"], "expected hf://datasets/ORG/NAME/FILE.zarr"),
    ):
        assert analyze(["copy", str(store), *words]) == 2
        said = capsys.readouterr().err
        assert expected in said
        assert said.count("\n") == 1
        assert not Path(target).exists()
    client.refuses = True
    assert analyze(["copy", str(store), target, "--packed", "--push", ADDRESS]) == 2
    said = capsys.readouterr().err
    assert "403 Forbidden" in said
    assert said.count("\n") == 1
    assert verify_store(open_store(target)) == []
