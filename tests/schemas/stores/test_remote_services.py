"""Stores in S3 (moto's server on the loopback), and on the hub, of which a web server with its addresses stands in."""

from __future__ import annotations

import json
import shutil
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.kit.http_ranges import Served, serve
from vla_attention.analyze.__main__ import main as analyze
from vla_attention.analyze.copy.copying import copy_store
from vla_attention.schemas.stores import remote_source
from vla_attention.schemas.stores.digest import seal_digest
from vla_attention.schemas.stores.reader import open_store
from vla_attention.schemas.stores.verify import verify_store
from vla_attention.testing.stores import StoreSpec, write_store

pytest.importorskip("aiohttp", reason="needs the extra remote: pip install 'vla-attention[remote]'")


COMMIT = "a" * 40


@pytest.fixture(scope="module")
def stores(tmp_path_factory) -> tuple[Path, Path]:
    """A store of folders, and the same packed."""
    made = tmp_path_factory.mktemp("stores")
    folder = write_store(made / "folder.zarr", spec=StoreSpec(tasks=(0,), episodes=2, replans=2))
    copy_store(open_store(folder), made / "packed.zarr", (), packed=True)
    return folder, made / "packed.zarr"


def hub_commit(folder: Path, commit: str) -> Path:
    return folder / f"hub/datasets/org/name/resolve/{commit}"


def csv_of(place: str, out: Path) -> dict[str, bytes]:
    """The tables that the default command writes."""
    assert analyze([place, "--no-plots", "--output", str(out)]) == 0
    assert analyze(["groups", place, "--output", str(out / "groups")]) == 0
    return {str(file.relative_to(out)): file.read_bytes() for file in sorted(out.rglob("*.parquet"))}


@pytest.fixture
def bucket(stores, monkeypatch) -> Iterator[str]:
    """A bucket with both stores on a server of the loopback."""
    s3fs = pytest.importorskip("s3fs", reason="needs the extra remote")
    moto = pytest.importorskip("moto.server", reason="needs moto[server]")
    import boto3

    for name, value in {
        "AWS_ACCESS_KEY_ID": "made-up",
        "AWS_SECRET_ACCESS_KEY": "made-up",
        "AWS_DEFAULT_REGION": "us-east-1",
    }.items():
        monkeypatch.setenv(name, value)
    server = moto.ThreadedMotoServer(ip_address="127.0.0.1", port=0, verbose=False)
    server.start()
    try:
        host, port = server.get_host_and_port()
        monkeypatch.setenv("AWS_ENDPOINT_URL", f"http://{host}:{port}")
        client = boto3.client("s3", endpoint_url=f"http://{host}:{port}")
        client.create_bucket(Bucket="stores")
        for store in stores:
            for file in store.rglob("*"):
                if file.is_file():
                    client.put_object(
                        Bucket="stores", Key=file.relative_to(store.parent).as_posix(), Body=file.read_bytes()
                    )
        yield "s3://stores"
    finally:
        server.stop()
        # The next server has another port.
        remote_source._file_system_of.cache_clear()
        s3fs.S3FileSystem.clear_instance_cache()


def test_stores_in_s3_give_the_same_tables(bucket, stores, tmp_path, capsys):
    expected = csv_of(str(stores[0]), tmp_path / "here")
    assert expected
    for name in ("packed", "folder"):  # S3 lists folders: a store need not be packed
        assert csv_of(f"{bucket}/{name}.zarr", tmp_path / name).keys() == expected.keys()
        assert verify_store(open_store(f"{bucket}/{name}.zarr")) == []
        text = (tmp_path / name / "summary.txt").read_text()
        assert text.replace(f"{bucket}/{name}.zarr", "S") == (tmp_path / "here" / "summary.txt").read_text().replace(
            str(stores[0]), "S"
        )
    capsys.readouterr()
    for wrong in (f"{bucket}/none.zarr", "s3://no-such-bucket/a.zarr"):
        assert analyze([wrong, "--no-plots"]) == 2
        said = capsys.readouterr().err
        assert wrong in said
        assert said.count("\n") == 1


def point_main_at(hub: Path, commit: str) -> None:
    revisions = hub / "api/datasets/org/name/revision"
    revisions.mkdir(parents=True, exist_ok=True)
    (revisions / "main").write_text(json.dumps({"id": "org/name", "sha": commit}))


def list_commit(hub: Path, commit: str) -> None:
    """What the hub says of a commit: that it is one, and the files of its store's group of episodes."""
    (hub / "api/datasets/org/name/revision" / commit).write_text(json.dumps({"id": "org/name", "sha": commit}))
    base, lists = hub / f"datasets/org/name/resolve/{commit}", hub / f"api/datasets/org/name/tree/{commit}/runs/a.zarr"
    files = [file for file in sorted((base / "runs/a.zarr/episodes").rglob("*")) if file.is_file()]
    lists.mkdir(parents=True)
    entries = [{"type": "file", "path": str(file.relative_to(base)), "size": 1, "oid": "0" * 40} for file in files]
    (lists / "episodes").write_text(json.dumps(entries))


@pytest.fixture
def hub(stores, tmp_path, monkeypatch) -> Iterator[Served]:
    """A server with the addresses under which the hub serves files, of commits only, and says what `main` is."""
    shutil.copytree(stores[1], hub_commit(tmp_path, COMMIT) / "runs/a.zarr")
    point_main_at(tmp_path / "hub", COMMIT)
    list_commit(tmp_path / "hub", COMMIT)
    with serve(tmp_path / "hub") as served:
        monkeypatch.setenv("HF_ENDPOINT", served.url)
        monkeypatch.setenv("HF_TOKEN", "made-up")
        yield served


def test_a_store_on_the_hub_is_read_by_ranges(hub, stores, tmp_path, capsys):
    url = "hf://datasets/org/name/runs/a.zarr"
    assert csv_of(url, tmp_path / "there").keys() == csv_of(str(stores[1]), tmp_path / "here").keys()
    for name in ("summary.txt",):
        there, here = (tmp_path / "there" / name).read_text(), (tmp_path / "here" / name).read_text()
        assert there.replace(url.replace("name/", f"name@{COMMIT}/"), "S") == here.replace(str(stores[1]), "S")
    assert all(wanted for path, wanted in hub.requests if path.endswith(".zip"))
    assert verify_store(open_store(url)) == []
    capsys.readouterr()
    for wrong, expected in (
        ("hf://datasets/org/name/runs/b.zarr", "There is no store at"),
        ("hf://datasets/org", "expected hf://datasets/ORG/NAME/PATH"),
        ("hf://datasets/org/name@v2/runs/a.zarr", "knows no revision v2 of org/name"),
        ("hf://datasets/org/other/a.zarr", "knows no revision main of org/other"),
    ):
        assert analyze([wrong, "--no-plots"]) == 2
        said = capsys.readouterr().err
        assert expected in said
        assert said.count("\n") == 1


def test_a_branch_is_asked_for_once_and_everything_is_read_at_its_commit(hub, stores, tmp_path, capsys):
    """While the store is read, somebody moves `main` to a commit that has nothing of it."""

    def move(path: str, content: bytes) -> bytes:
        if path.endswith("a.zarr/zarr.json"):
            point_main_at(tmp_path / "hub", "b" * 40)
        return content

    hub.change = move
    assert analyze(["copy", "hf://datasets/org/name/runs/a.zarr", str(tmp_path / "here.zarr")]) == 0
    assert sum(path.endswith("/revision/main") for path, _ in hub.requests) == 1
    assert all(f"/resolve/{COMMIT}/" in path for path, _ in hub.requests if "/resolve/" in path)
    assert any(f"/tree/{COMMIT}/" in path for path, _ in hub.requests)
    copied = open_store(tmp_path / "here.zarr")
    assert copied.attributes.provenance["fetched_from"] == f"hf://datasets/org/name@{COMMIT}/runs/a.zarr"
    assert copied.run == open_store(stores[0]).run
    assert verify_store(copied) == []
    # A copy is of one commit. With it the same command goes on.
    capsys.readouterr()
    shutil.copytree(hub_commit(tmp_path, COMMIT), hub_commit(tmp_path, "b" * 40))
    list_commit(tmp_path / "hub", "b" * 40)
    assert analyze(["copy", "hf://datasets/org/name/runs/a.zarr", str(tmp_path / "here.zarr")]) == 2
    said = capsys.readouterr().err
    assert f"it is of hf://datasets/org/name@{COMMIT}/runs/a.zarr" in said
    assert said.count("\n") == 1
    assert analyze(["copy", f"hf://datasets/org/name@{COMMIT}/runs/a.zarr", str(tmp_path / "here.zarr")]) == 0
    assert "2 were there already" in capsys.readouterr().out


def lacking(index: Path) -> bytes:
    """An index without the second episode, whose zip is there, and with its right digest."""
    document = json.loads(index.read_text())
    del document["episodes"]["task000_episode001"]
    return json.dumps(document | {"digest": seal_digest(document)}).encode()


def check_one_is_lacking(url: str, capsys: pytest.CaptureFixture[str]) -> None:
    lost = "episodes/task000_000/task000_episode001.zip"
    assert analyze(["verify", url]) == 1
    assert f"{lost}: index.json does not list it" in capsys.readouterr().out
    assert analyze([url, "--list"]) == 0
    assert f"what its index.json does not list, {lost}" in capsys.readouterr().err


def test_a_zip_that_the_index_lacks_is_found_on_the_hub(hub, tmp_path, capsys):
    index = hub_commit(tmp_path, COMMIT) / "runs/a.zarr/index.json"
    index.write_bytes(lacking(index))
    check_one_is_lacking("hf://datasets/org/name/runs/a.zarr", capsys)


def test_a_zip_that_the_index_lacks_is_found_in_s3(bucket, stores, capsys):
    import boto3

    body = lacking(stores[1] / "index.json")
    boto3.client("s3").put_object(Bucket="stores", Key="packed.zarr/index.json", Body=body)
    check_one_is_lacking(f"{bucket}/packed.zarr", capsys)


def test_a_merged_store_names_the_commit(hub, tmp_path):
    more = write_store(tmp_path / "more.zarr", spec=StoreSpec(tasks=(1,), episodes=1, replans=2))
    url = "hf://datasets/org/name/runs/a.zarr"
    assert analyze(["copy", url, str(more), "-o", str(tmp_path / "all.zarr")]) == 0
    assert open_store(tmp_path / "all.zarr").attributes.provenance["merged_from"] == (
        f"hf://datasets/org/name@{COMMIT}/runs/a.zarr (2 episodes), more.zarr (1 episode)"
    )


@pytest.mark.parametrize("answer", ["{}", "no JSON", '{"sha": "main"}', "[]", '{"sha": 5}'])
def test_a_hub_that_states_no_commit(hub, tmp_path, capsys, answer):
    (tmp_path / "hub/api/datasets/org/name/revision/main").write_text(answer)
    assert analyze(["hf://datasets/org/name/runs/a.zarr", "--list"]) == 2
    assert "did not say which commit main is" in capsys.readouterr().err


def test_the_token_goes_to_the_hub_and_not_where_it_sends_readers(hub, stores, tmp_path):
    """The hub keeps large files at another address, and answers with that."""
    with serve(tmp_path / "hub") as elsewhere:
        hub.redirect = elsewhere.url
        episode = open_store("hf://datasets/org/name/runs/a.zarr").episodes[0]
        assert np.array_equal(episode.read("joint/rows"), open_store(stores[1]).episodes[0].read("joint/rows"))
        assert hub.authorizations == {"Bearer made-up"}
        assert elsewhere.authorizations == {""}
        assert elsewhere.of_episodes() > 0 == hub.of_episodes()


@pytest.mark.parametrize("missing", ["fsspec", "aiohttp"])
def test_a_missing_package_is_named(missing, monkeypatch, capsys):
    from fsspec.registry import _registry

    remote_source._file_system_of.cache_clear()
    real = __import__

    def refuse(name: str, *arguments: Any, **options: Any) -> Any:
        if name.partition(".")[0] == missing:
            raise ImportError(f"No module named '{missing}'", name=missing)
        return real(name, *arguments, **options)

    for name in list(sys.modules):
        if name.partition(".")[0] == missing or name == "fsspec.implementations.http":
            monkeypatch.delitem(sys.modules, name)
    monkeypatch.delitem(_registry, "https", raising=False)  # classes that fsspec has imported already
    monkeypatch.setattr("builtins.__import__", refuse)
    assert analyze(["https://127.0.0.1:9/x.zarr", "--no-plots"]) == 2
    monkeypatch.undo()
    remote_source._file_system_of.cache_clear()
    said = capsys.readouterr().err
    assert "vla-attention[remote]" in said
    assert said.count("\n") == 1
