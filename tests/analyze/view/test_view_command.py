"""`vla-attention view`: the numbers of its summary, the static site, its link, and its end."""

from __future__ import annotations

import json
import re
import shutil
import sys
import webbrowser
import zipfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import vla_attention as va
from tests.kit.http_ranges import serve
from tests.kit.stopped_programs import after_call, run_stopped
from tests.kit.viewer import ask, served
from vla_attention.analyze.__main__ import main
from vla_attention.analyze.show.browser import has_screen, open_page
from vla_attention.analyze.view.paths import PAGE_FILES
from vla_attention.analyze.view.summary_process import summary_parts
from vla_attention.schemas.stores.digest import seal_digest
from vla_attention.schemas.stores.reader import open_store
from vla_attention.testing.site_stores import SiteStoreSpec, write_site_store
from vla_attention.testing.stores import StoreSpec, small_effects, write_store

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
    expected = va.open(store).ratios("episodes").filter(layer="layers_avg").sort("task_id", "episode_index")
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


def test_before_the_numbers_there_are_the_episodes(store):
    with served(store) as running:
        running.stores[0].summary.begin(running.stores[0].store)
        document = json.loads(ask(running, "stores/0.summary.json").body)
        names = [entry["name"] for entry in json.loads(ask(running, "stores.json").body)["stores"][0]["episodes"]]
    assert [row["name"] for row in document["episodes"]] == names


def test_a_damaged_episode_has_no_numbers_and_the_others_have(store, tmp_path):
    damaged = tmp_path / "a.zarr"
    shutil.copytree(store, damaged)
    (damaged / "episodes/task001_episode000/joint/key_role/zarr.json").unlink()
    parts = list(summary_parts(open_store(damaged)))
    (failed,) = [part["failed"] for part in parts if "failed" in part]
    assert "task001_episode000" in failed
    rows = {row["name"]: row for part in parts for row in part.get("episodes", ())}
    assert [rows[name]["ratio"] is None for name in sorted(rows)] == [False, False, True, False]


def test_the_units_of_effects_come_first_or_why_there_are_none(tmp_path):
    path = write_store(tmp_path / "a.zarr", spec=replace(SPEC, plant_effects=small_effects))
    _, part, *rest = summary_parts(open_store(path))
    actions = np.concatenate([episode.read("actions").reshape(-1, 7) for episode in open_store(path).episodes])
    assert part == {"effect_units": {"spread": pytest.approx(actions.std(axis=0))}}
    assert not any("effect_units" in each for each in rest)
    (path / "episodes/task001_episode000/actions/zarr.json").unlink()
    _, part, *_ = summary_parts(open_store(path))
    assert "task001_episode000" in part["effect_units"]["failed"]
    assert not any("effect_units" in each for each in summary_parts(open_store(write_store(tmp_path / "b.zarr"))))


def test_a_site_without_both_sides_has_no_ratio(tmp_path):
    store = write_site_store(tmp_path / "a.zarr", SiteStoreSpec(kind="split"))
    *_, last = summary_parts(open_store(store))
    assert "failed" not in last
    assert last["episodes"][0]["replans"]
    assert last["episodes"][0]["ratio"] is None


def test_a_site_is_the_page_its_documents_and_a_link_to_the_store(store, tmp_path, capsys):
    folder = tmp_path / "site"
    for _ in range(2):  # a second time over the first
        assert main(["view", str(store), "--site", str(folder)]) == 0
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
    "keys (a link)": lambda store, secret: (store / "keys").symlink_to(secret),
    "episodes/zarr.json (a link)": lambda store, secret: replace_by_link(store / "episodes/zarr.json", secret / "id"),
    "episodes/drafts/": lambda store, secret: (store / "episodes/drafts").mkdir(),
    "episodes/task000_episode000/.DS_Store": lambda store, secret: (
        store / "episodes/task000_episode000/.DS_Store"
    ).write_text("mine"),
    "episodes/task000_episode000/joint/rows/keys (a link)": lambda store, secret: (
        store / "episodes/task000_episode000/joint/rows/keys"
    ).symlink_to(secret),
    "episodes/task000_episode000/state/zarr.json (a link)": lambda store, secret: replace_by_link(
        store / "episodes/task000_episode000/state/zarr.json", store / "episodes/task000_episode001/state/zarr.json"
    ),
}


def replace_by_link(file: Path, target: Path) -> None:
    file.unlink()
    file.symlink_to(target)


@pytest.mark.filterwarnings("ignore:Ignored in")
@pytest.mark.parametrize("name", FOREIGN)
def test_a_site_publishes_nothing_but_the_store(store, tmp_path, capsys, name):
    (tmp_path / "secret").mkdir()
    (tmp_path / "secret/id").write_text("secret")
    shutil.copytree(store, tmp_path / "a.zarr")
    FOREIGN[name](tmp_path / "a.zarr", tmp_path / "secret")
    assert main(["view", str(tmp_path / "a.zarr"), "--site", str(tmp_path / "site")]) == 2
    assert f"Cannot write a site of {tmp_path / 'a.zarr'}: {name} would be published" in capsys.readouterr().err
    assert not (tmp_path / "site").exists()


@pytest.mark.filterwarnings("ignore:Ignored in", "ignore:Left out")
def test_a_site_of_a_packed_store_publishes_nothing_but_the_store(store, tmp_path, capsys):
    packed = tmp_path / "p.zarr"
    assert main(["copy", str(store), str(packed), "--packed"]) == 0
    folder = packed / "episodes/task000_000"
    shutil.copyfile(folder / "task000_episode000.zip", folder / "task000_episode009.zip")
    (folder / "mine.zip").write_text("mine")
    replace_by_link(folder / "task000_episode001.zip", folder / "task000_episode000.zip")
    with zipfile.ZipFile(packed / "episodes/task001_000/task001_episode000.zip", "a") as found:
        found.writestr("mine", "mine")
    index = json.loads((packed / "index.json").read_text())
    size = (packed / "episodes/task001_000/task001_episode000.zip").stat().st_size
    index["episodes"]["task001_episode000"] |= {"bytes": size, "tail": 0}
    (packed / "index.json").write_text(json.dumps(index | {"digest": seal_digest(index)}))
    assert main(["view", str(packed), "--site", str(tmp_path / "site")]) == 2
    said = capsys.readouterr().err
    for name in ("mine.zip", "task000_episode001.zip (a link)", "task000_episode009.zip"):
        assert f"episodes/task000_000/{name}" in said
    assert "episodes/task001_episode000/mine" in said


def test_what_an_upload_takes_along(store, tmp_path, capsys):
    """Of a second site in the same place, too: the links of the first are gone, and others are refused."""
    other = write_store(tmp_path / "b.zarr", spec=SPEC, suite="other")
    site = tmp_path / "site"
    assert main(["view", str(store), str(other), "--site", str(site)]) == 0
    assert main(["view", str(store), "--site", str(site)]) == 0
    published = upload(site, tmp_path / "uploaded")
    files = {f"stores/0/{file.relative_to(store)}" for file in store.rglob("*") if file.is_file()}
    assert set(published) == {*PAGE_FILES, "stores.json", "stores/0.summary.json", *files}
    capsys.readouterr()
    for link in ("mine", "stores/mine"):
        (site / link).symlink_to(tmp_path)
        assert main(["view", str(store), "--site", str(site)]) == 2
        assert f"it has the link {link}, and an upload that follows links" in capsys.readouterr().err
        (site / link).unlink()


def test_a_site_of_a_store_elsewhere_names_its_address(store, tmp_path, capsys):
    pytest.importorskip("aiohttp")
    assert main(["copy", str(store), str(tmp_path / "p.zarr"), "--packed"]) == 0
    with serve(tmp_path) as elsewhere:
        assert main(["view", f"{elsewhere.url}/p.zarr", "--site", str(tmp_path / "site")]) == 0
    assert "CORS" in capsys.readouterr().out
    (entry,) = json.loads((tmp_path / "site/stores.json").read_text())["stores"]
    assert entry["root"] == f"{elsewhere.url}/p.zarr/"
    assert entry["packed"]


@pytest.mark.parametrize("place", ["a.zarr", "file", "full", "hub/datasets"])
def test_a_site_is_written_into_no_store_and_over_nothing_else(store, tmp_path, capsys, place):
    (tmp_path / "file").write_text("mine")
    (tmp_path / "full").mkdir()
    (tmp_path / "full/mine").write_text("mine")
    if place == "hub/datasets":
        (tmp_path / place).mkdir(parents=True)
        (tmp_path / place / "zarr.json").write_text("{}")
    before = sorted(tmp_path.rglob("*"))
    assert main(["view", str(store), "--site", str(tmp_path / place)]) == 2
    assert "Cannot write a site into" in capsys.readouterr().err
    assert sorted(tmp_path.rglob("*")) == before


def test_addresses_that_browsers_cannot_read_are_refused_for_a_site(tmp_path, capsys):
    assert main(["view", "s3://bucket/a.zarr", "--site", str(tmp_path / "site")]) == 2
    assert "Browsers cannot read s3://bucket/a.zarr" in capsys.readouterr().err


def test_what_is_no_store_is_refused_with_a_sentence(tmp_path, capsys):
    assert main(["view", str(tmp_path / "none.zarr"), "--no-open"]) == 2
    assert "There is no store at" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("signal", "code", "word"), [("SIGINT", 130, "stopped"), ("SIGTERM", 143, "stopped by SIGTERM")]
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
    # Started again on the same port, it has the same link.
    again = ["view", str(store), "--no-open", "--port", found[3]]
    assert run_stopped("vla_attention.analyze", again, moment, signal=signal).stdout == done.stdout


def test_a_browser_is_opened_before_a_screen_only():
    assert has_screen("linux", {"DISPLAY": ":0"})
    assert has_screen("linux", {"WAYLAND_DISPLAY": "wayland-0"})
    assert has_screen("darwin", {})
    assert not has_screen("linux", {})
    assert not has_screen("linux", {"DISPLAY": ""})
    assert not has_screen("darwin", {"SSH_CONNECTION": "1 2 3 4"})


def test_a_report_is_opened_or_the_reason_is_said(store, tmp_path, capsys, monkeypatch):
    opened: list[str] = []
    monkeypatch.setattr(webbrowser, "open", lambda address: opened.append(address) or True)
    page = tmp_path / "report.html"
    words = ["report", str(store), "--quick", "--episodes", "0", "--output", str(page), "--open"]
    monkeypatch.setenv("DISPLAY", ":0")
    assert main(words) == 0
    assert opened == [page.as_uri()]
    assert capsys.readouterr().out.endswith("on 4 episodes.\n")
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(sys, "platform", "linux")
    assert (
        open_page(page)
        == f"There is no screen or no browser here, so {page} was not opened; copy it to where there is one."
    )
    assert opened == [page.as_uri()]


def test_the_analysis_ends_by_naming_the_report_and_the_viewer(store, tmp_path, capsys, monkeypatch):
    words = ["--no-plots", "--output", str(tmp_path / "out")]
    long = tmp_path / f"{'long' * 20}.zarr"
    shutil.copytree(store, long)
    assert main([str(long), *words]) == 0
    assert capsys.readouterr().out.endswith(
        "One page of it: vla-attention report STORE --open; to explore it: vla-attention view STORE\n"
    )
    monkeypatch.chdir(store.parent)
    assert main(["a.zarr", *words]) == 0
    assert capsys.readouterr().out.endswith(
        "One page of it: vla-attention report a.zarr --open\nTo explore it: vla-attention view a.zarr\n"
    )
