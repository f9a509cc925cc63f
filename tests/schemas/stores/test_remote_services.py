"""Stores in S3 (moto's server on the loopback), and on the hub, of which a web server with its addresses stands in."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from tests.kit.http_ranges import Served, serve
from tests.kit.stores import StoreSpec, write_store
from vla_attention.analyze.__main__ import main as analyze
from vla_attention.analyze.store.copying import copy_store
from vla_attention.schemas.stores import remote_source
from vla_attention.schemas.stores.reader import open_store
from vla_attention.schemas.stores.verify import verify_store

pytestmark = pytest.mark.thorough

pytest.importorskip("aiohttp", reason="needs the extra remote: pip install '.[remote]'")


COMMIT = "a" * 40


@pytest.fixture(scope="module")
def stores(tmp_path_factory) -> tuple[Path, Path]:
    """A store, and a copy of it."""
    made = tmp_path_factory.mktemp("stores")
    folder = write_store(made / "folder.zarr", spec=StoreSpec(tasks=(0,), episodes=2, replans=2))
    copy_store(open_store(folder), made / "copied.zarr", ())
    return folder, made / "copied.zarr"


def hub_commit(folder: Path, commit: str) -> Path:
    return folder / f"hub/datasets/org/name/resolve/{commit}"


def csv_of(place: str, out: Path) -> dict[str, bytes]:
    """The tables that the default command writes."""
    assert analyze([place, "--no-plots", "--output", str(out)]) == 0
    assert analyze(["analyze", place, "--list", "--output", str(out / "groups")]) == 0
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
    for name in ("copied", "folder"):
        assert csv_of(f"{bucket}/{name}.zarr", tmp_path / name).keys() == expected.keys()
        assert verify_store(open_store(f"{bucket}/{name}.zarr")) == []
        text = (tmp_path / name / "result.json").read_text()
        assert text.replace(f"{bucket}/{name}.zarr", "S") == (tmp_path / "here" / "result.json").read_text().replace(
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
    """What the hub says of a commit: that it is one, and what its store's group of episodes has."""
    (hub / "api/datasets/org/name/revision" / commit).write_text(json.dumps({"id": "org/name", "sha": commit}))
    base, lists = hub / f"datasets/org/name/resolve/{commit}", hub / f"api/datasets/org/name/tree/{commit}/runs/a.zarr"
    lists.mkdir(parents=True)
    entries = [
        {
            "type": "directory" if path.is_dir() else "file",
            "path": str(path.relative_to(base)),
            "size": 1,
            "oid": "0" * 40,
        }
        for path in sorted((base / "runs/a.zarr/episodes").iterdir())
    ]
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
    for name in ("result.json",):
        there, here = (tmp_path / "there" / name).read_text(), (tmp_path / "here" / name).read_text()
        assert there.replace(url.replace("name/", f"name@{COMMIT}/"), "S") == here.replace(str(stores[1]), "S")
    assert verify_store(open_store(url)) == []
    capsys.readouterr()
    for wrong, named in (
        ("hf://datasets/org/name/runs/b.zarr", "b.zarr"),
        ("hf://datasets/org", "hf://datasets/ORG/NAME/PATH"),
        ("hf://datasets/org/name@v2/runs/a.zarr", "revision v2 of org/name"),
        ("hf://datasets/org/other/a.zarr", "revision main of org/other"),
    ):
        assert analyze([wrong, "--no-plots"]) == 2
        said = capsys.readouterr().err
        assert named in said
        assert said.count("\n") == 1


def test_the_token_goes_to_the_hub_and_not_where_it_sends_readers(hub, stores, tmp_path):
    """The hub keeps large files at another address, and answers with that."""
    with serve(tmp_path / "hub") as elsewhere:
        hub.redirect = elsewhere.url
        episode = open_store("hf://datasets/org/name/runs/a.zarr").episodes[0]
        assert np.array_equal(episode.read("joint/rows"), open_store(stores[1]).episodes[0].read("joint/rows"))
        assert hub.authorizations == {"Bearer made-up"}
        assert elsewhere.authorizations == {""}
        assert elsewhere.of_episodes() > 0 == hub.of_episodes()
