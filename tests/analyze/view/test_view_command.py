"""`vla-attention view`: the numbers of its summary, the static site, its link, and its end."""

from __future__ import annotations

import json
import re
import shutil
from pathlib import Path

import pytest

import vla_attention as va
from tests.kit.stopped_programs import after_call, run_stopped
from tests.kit.stores import StoreSpec, write_store
from tests.kit.viewer import ask, served
from vla_attention.analyze.__main__ import main
from vla_attention.analyze.view.paths import PAGE_FILES
from vla_attention.analyze.view.summary_process import summary_parts
from vla_attention.schemas.stores.reader import open_store

SPEC = StoreSpec(tasks=(0, 1), episodes=2, replans=2)


@pytest.fixture(scope="module")
def store(tmp_path_factory) -> Path:
    return write_store(tmp_path_factory.mktemp("viewed") / "a.zarr", spec=SPEC)


def test_the_summary_has_the_numbers_of_the_analysis(store):
    with served(store, summaries=True) as running:
        assert running.stores[0].summary.wait() is None
        document = json.loads(ask(running, "stores/0.summary.json").body)
    assert (document["complete"], document["failed"], document["site"]) == (True, None, "joint")
    assert document["grouping"] == "default"
    assert document["ratio"] == "visual / linguistic"
    expected = va.open(store).analyze()["episodes"].filter(layer="layers_avg").sort("task_id", "episode_index")
    for found, row in zip(document["episodes"], expected.iter_rows(named=True), strict=True):
        assert found["name"] == f"task{row['task_id']:03d}_episode{row['episode_index']:03d}"
        for name, column in (
            ("task", "task_id"),
            ("episode", "episode_index"),
            ("instruction", "instruction"),
            ("success", "success"),
            ("replans", "num_replans"),
            ("ratio", "geometric_mean"),
            ("lift", "ratio_lift"),
        ):
            assert found[name] == row[column], name


def test_a_damaged_episode_has_no_numbers_and_the_others_have(store, tmp_path):
    damaged = tmp_path / "a.zarr"
    shutil.copytree(store, damaged)
    (damaged / "episodes/task001_episode000/joint/key_role/c.0.0").unlink()
    parts = list(summary_parts(open_store(damaged)))
    (failed,) = [part["failed"] for part in parts if "failed" in part]
    assert "task001_episode000" in failed
    rows = {row["name"]: row for part in parts for row in part.get("episodes", ())}
    assert [rows[name]["ratio"] is None for name in sorted(rows)] == [False, False, True, False]


def test_a_site_is_the_page_its_documents_and_a_link_to_the_store(store, tmp_path, capsys):
    folder = tmp_path / "site"
    for _ in range(2):  # a second time over the first
        assert main(["view", str(store), "--output", str(folder)]) == 0
        printed = capsys.readouterr().out
        assert f"stores/0 (a link to {store})" in printed
        assert "range requests" in printed
    with served(store, summaries=True) as running:
        running.stores[0].summary.wait()
        for name in (*PAGE_FILES, "stores.json", "stores/0.summary.json", "stores/0/zarr.json"):
            live, written = ask(running, name).body, (folder / name).read_bytes()
            if name == "stores.json":
                shown, wrote = json.loads(live), json.loads(written)
                assert shown["stores"][0].pop("path") == str(store)  # on the web nobody needs it
                assert shown == wrote
            elif name.endswith(".json"):
                assert json.loads(live) == json.loads(written), name
            else:
                assert live == written, name
    assert (folder / "stores/0").resolve() == store
    files = {path.relative_to(folder).as_posix() for path in folder.rglob("*") if not path.is_dir()}
    assert files == {*PAGE_FILES, "stores.json", "stores/0.summary.json"} | ({"stores/0"} & files)


def upload(folder: Path, target: Path) -> dict[str, bytes]:
    """What a copy that follows links takes along, by path."""
    shutil.copytree(folder, target, symlinks=False)
    return {file.relative_to(target).as_posix(): file.read_bytes() for file in target.rglob("*") if file.is_file()}


#: What somebody may put into a store, and what of it an upload that follows links would publish.
FOREIGN = {
    "notes.txt": lambda store, secret: (store / "notes.txt").write_text("mine"),
    "keys": lambda store, secret: (store / "keys").symlink_to(secret),
    "joint/rows/keys": lambda store, secret: (store / "episodes/task000_episode000/joint/rows/keys").symlink_to(secret),
}


@pytest.mark.filterwarnings("ignore:Ignored in")
@pytest.mark.parametrize("name", FOREIGN)
def test_a_site_publishes_nothing_but_the_store(store, tmp_path, capsys, name):
    (tmp_path / "secret").mkdir()
    (tmp_path / "secret/id").write_text("secret")
    shutil.copytree(store, tmp_path / "a.zarr")
    FOREIGN[name](tmp_path / "a.zarr", tmp_path / "secret")
    assert main(["view", str(tmp_path / "a.zarr"), "--output", str(tmp_path / "site")]) == 2
    assert f"Cannot write a site of {tmp_path / 'a.zarr'}: {name} would be published" in capsys.readouterr().err
    assert not (tmp_path / "site").exists()


@pytest.mark.thorough
def test_what_an_upload_takes_along(store, tmp_path, capsys):
    """Of a second site in the same place, too: the links of the first are gone, and others are refused."""
    other = write_store(tmp_path / "b.zarr", spec=SPEC, suite="other")
    site = tmp_path / "site"
    assert main(["view", str(store), str(other), "--output", str(site)]) == 0
    assert main(["view", str(store), "--output", str(site)]) == 0
    published = upload(site, tmp_path / "uploaded")
    files = {f"stores/0/{file.relative_to(store)}" for file in store.rglob("*") if file.is_file()}
    assert set(published) == {*PAGE_FILES, "stores.json", "stores/0.summary.json", *files}
    capsys.readouterr()
    for link in ("mine", "stores/mine"):
        (site / link).symlink_to(tmp_path)
        assert main(["view", str(store), "--output", str(site)]) == 2
        assert f"it has the link {link}, and an upload that follows links" in capsys.readouterr().err
        (site / link).unlink()


@pytest.mark.parametrize("place", ["a.zarr", "file", "full", "hub/datasets"])
def test_a_site_is_written_into_no_store_and_over_nothing_else(store, tmp_path, capsys, place):
    (tmp_path / "file").write_text("mine")
    (tmp_path / "full").mkdir()
    (tmp_path / "full/mine").write_text("mine")
    if place == "hub/datasets":
        (tmp_path / place).mkdir(parents=True)
        (tmp_path / place / "zarr.json").write_text("{}")
    before = sorted(tmp_path.rglob("*"))
    assert main(["view", str(store), "--output", str(tmp_path / place)]) == 2
    assert "Cannot write a site into" in capsys.readouterr().err
    assert sorted(tmp_path.rglob("*")) == before


def test_what_is_no_store_is_refused_with_a_sentence(tmp_path, capsys):
    assert main(["view", str(tmp_path / "none.zarr"), "--no-open"]) == 2
    assert "There is no store at" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("signal", "code", "word"),
    [("SIGINT", 130, "stopped"), pytest.param("SIGTERM", 143, "stopped by SIGTERM", marks=pytest.mark.thorough)],
)
def test_it_ends_with_one_sentence(store, signal, code, word, tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    moment = after_call("vla_attention.analyze.view.server", "ViewerServer", "service_actions")
    done = run_stopped("vla_attention.analyze", ["view", str(store), "--no-open"], moment, signal=signal)
    assert done.returncode == code
    found = re.match(r"The page: (http://127\.0\.0\.1:(\d+)/[\w-]{32}/)\n.*; with --port (\d+) its", done.stdout)
    assert found
    assert found[2] == found[3]
    assert done.stderr.strip() == f"vla-analyze view: {word}; nothing was left half written."
    # Started again on the same port, it has the same link; and says how a proxy has it.
    again = ["view", str(store), "--no-open", "--port", found[3], "--allow-host", "hub.example.org"]
    said = run_stopped("vla_attention.analyze", again, moment, signal=signal).stdout
    assert said.startswith(done.stdout)
    token = found[1].split("/")[3]
    assert f"https://hub.example.org/user/NAME/proxy/{found[3]}/{token}/" in said
