"""`vla-attention view`: the numbers of its summary, the site, the page in one file, its link, and its end."""

from __future__ import annotations

import base64
import gzip
import json
import re
import shutil
import time
from pathlib import Path

import pytest

import vla_attention as va
from tests.kit.planted_effects import planted_effects
from tests.kit.stopped_programs import after_call, run_stopped
from tests.kit.stores import StoreSpec, small_steps, write_store
from tests.kit.viewer import ask, served
from vla_attention.analyze.__main__ import main
from vla_attention.analyze.view.paths import PAGE_FILES
from vla_attention.analyze.view.summary_process import summary_parts
from vla_attention.schemas.stores.reader import open_store
from vla_attention.schemas.stores.store_format import parse_episode_name

SPEC = StoreSpec(tasks=(0, 1), episodes=2, replans=2, plant_effects=planted_effects())


@pytest.fixture(scope="module")
def store(tmp_path_factory) -> Path:
    return write_store(tmp_path_factory.mktemp("viewed") / "a.zarr", spec=SPEC)


def test_the_summary_has_the_numbers_of_the_analysis(store):
    with served(store, summaries=True) as running:
        assert running.stores[0].summary.wait() is None
        document = json.loads(ask(running, "runs/0/numbers.json").body)
    assert (document["complete"], document["failed"]) == (True, None)
    assert document["ratio"] == "visual / linguistic"
    expected = va.open(store).analyze()["episodes"].filter(layer="layers_avg").sort("task_id", "episode_index")
    for found, row in zip(document["episodes"], expected.iter_rows(named=True), strict=True):
        assert found["name"] == f"task{row['task_id']:03d}_episode{row['episode_index']:03d}"
        assert [found["ratio"], found["lift"]] == pytest.approx([row["geometric_mean"], row["ratio_lift"]])


def test_what_needs_no_attention_is_said_first(tmp_path):
    spec = StoreSpec(tasks=(0, 1), episodes=2, replans=2, plant_steps=small_steps, plant_effects=planted_effects())
    opened = open_store(write_store(tmp_path / "a.zarr", spec=spec))
    parts = list(summary_parts(opened))
    first, *_, last = [part["findings"] for part in parts if "findings" in part]
    assert "findings" in parts[0]
    assert len(first) == 1
    assert first[0]["sentence"] in [one["sentence"] for one in last]
    entries = [at for at, part in enumerate(parts) if "episodes" in part]
    assert [at for at, part in enumerate(parts) if "leaves" in part] < entries
    (effects,) = [part["effects"] for part in parts if "effects" in part]
    rows = va.open(opened.path).effects()["effects_episodes"].filter(kind="without", item_kind="word", reader="total")
    for name, size in effects.items():
        task, episode = parse_episode_name(name)
        of_episode = rows.filter(task_id=task, episode_index=episode)
        assert size == pytest.approx(of_episode["effect"].mean())
    assert len(effects) == 4


@pytest.mark.skipif(
    not Path("/proc/self/stat").exists(), reason="the system does not say whether a process stands still"
)
def test_computing_stands_still_while_somebody_waits_for_an_answer(store):
    with served(store, summaries=True) as running:
        summary = running.stores[0].summary
        process = summary._process
        assert process is not None

        def state() -> str:
            return Path(f"/proc/{process.pid}/stat").read_text().rsplit(")")[-1].split()[0]

        with summary.paused(), summary.paused():
            while state() not in "TZ":
                time.sleep(0.001)
        while state() == "T":
            time.sleep(0.001)
        assert summary.wait() is None
        assert summary.document()["complete"]


def test_a_damaged_episode_has_no_numbers_and_the_others_have(store, tmp_path):
    damaged = tmp_path / "a.zarr"
    shutil.copytree(store, damaged)
    (damaged / "episodes/task001_episode000/joint/key_role/c.0.0").unlink()
    parts = list(summary_parts(open_store(damaged)))
    (failed,) = [part["failed"] for part in parts if "failed" in part]
    assert "task001_episode000" in failed
    rows = {row["name"]: row for part in parts for row in part.get("episodes", ())}
    assert [name for name in rows if rows[name]["ratio"] is None] == []
    assert sorted(rows) == ["task000_episode000", "task000_episode001", "task001_episode001"]


def answers_in(folder: Path) -> dict[str, bytes]:
    """The answers of a site by their addresses."""
    paths = [path for path in (folder / "runs").rglob("*") if path.is_file()]
    return {
        path.relative_to(folder).as_posix().removesuffix(".gz"): gzip.decompress(path.read_bytes())
        if path.suffix == ".gz"
        else path.read_bytes()
        for path in paths
    }


def test_a_site_has_the_servers_answers(store, tmp_path, capsys):
    folder = tmp_path / "site"
    for heads in (False, True):  # the second one over the first
        assert main(["view", str(store), "--site", str(folder), *(["--heads"] if heads else [])]) == 0
        assert re.match(r".*[\d.]+ [kM]B .*4 episodes", capsys.readouterr().out)
        answers = answers_in(folder)
        kinds = {re.sub(r"\d+|mean", "N", address.split("/", 3)[-1]) for address in answers}
        assert {"about.json", "joint/rows/N.npy", "joint/groups/N/N.json", "joint/grid/N.json"} <= kinds
        assert ("joint/heads/N.npy" in kinds) == heads
    with served(store, summaries=True) as running:
        running.stores[0].summary.wait()
        for name in PAGE_FILES:
            assert ask(running, name).body == (folder / name).read_bytes()
        for address, content in answers.items():
            assert ask(running, address).body == content, address
        live, copy = json.loads(ask(running, "runs.json").body), json.loads((folder / "runs.json").read_bytes())
    # Elsewhere nobody needs to know where it was.
    assert (live["runs"][0].pop("path"), live["runs"][0].pop("notes")) == (str(store), [])
    assert str(store).encode() not in b"".join(answers.values())
    assert copy == live | {"copy": {"heads": True}}
    assert not any(path.is_symlink() for path in folder.rglob("*"))


def test_a_site_of_a_store_with_a_damaged_episode_says_so(store, tmp_path, capsys):
    damaged = shutil.copytree(store, tmp_path / "a.zarr")
    (damaged / "episodes/task000_episode000/joint/key_role/c.0.0").unlink()
    assert main(["view", str(damaged), "--site", str(tmp_path / "site")]) == 0
    assert capsys.readouterr().err
    answers = answers_in(tmp_path / "site")
    with served(damaged) as running:
        reply = ask(running, "runs/0/task000_episode000/about.json")
    assert reply.status == 422
    assert answers["runs/0/task000_episode000/about.json"] == reply.body
    assert sum(address.startswith("runs/0/task000_episode000/") for address in answers) == 1
    assert not (tmp_path / "site/.new").exists()


def test_one_episode_is_one_file(store, tmp_path, capsys):
    path = tmp_path / "one.html"
    assert main(["view", str(store), "--file", str(path), "--task", "1", "--episode", "1"]) == 0
    text = path.read_text()
    (data,) = re.findall(r'<script type="application/json" id="answers">(.*?)</script>', text)
    within = {
        name: gzip.decompress(base64.b64decode(one)) for name, one in json.loads(data).items() if "png" not in name
    }
    (entry,) = json.loads(within["runs.json"])["runs"]
    assert [line["name"] for line in entry["episodes"]] == ["task001_episode001"]
    with served(store) as running:
        for name in ("about.json", "effects.json", "joint/rows/mean.npy", "joint/groups/mean/mean.json"):
            address = f"runs/0/task001_episode001/{name}"
            assert within[address] == ask(running, address).body
    assert main(["view", str(store), "--file", str(path), "--task", "7"]) == 2
    assert "task000_episode000" in capsys.readouterr().err
    no, other = ["--file", str(tmp_path / "no.html")], write_store(tmp_path / "b.zarr", spec=SPEC)
    rrd, site = ["--rrd", str(tmp_path / "rrd")], ["--site", str(tmp_path / "site")]
    for wrong in (
        *([*no, *site], [str(other), *no], ["--task", "0"], [*rrd, "--heads"], [*site, "--episode", "0"]),
        *([*no, "--port", "8765"], [*site, "--allow-host", "hub.example.org"], [*rrd, "--no-open"]),
    ):
        assert main(["view", str(store), *wrong]) == 2
    assert not any((tmp_path / name).exists() for name in ("no.html", "site", "rrd"))


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
    assert place in capsys.readouterr().err
    assert sorted(tmp_path.rglob("*")) == before


def test_what_is_no_store_is_refused_by_name(tmp_path, capsys):
    assert main(["view", str(tmp_path / "none.zarr"), "--no-open"]) == 2
    assert "none.zarr" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("signal", "code"),
    [("SIGINT", 130), pytest.param("SIGTERM", 143, marks=pytest.mark.thorough)],
)
def test_it_ends_with_one_line(store, signal, code, tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    moment = after_call("vla_attention.analyze.view.server", "ViewerServer", "service_actions")
    done = run_stopped("vla_attention.analyze", ["view", str(store), "--no-open"], moment, signal=signal)
    assert done.returncode == code
    found = re.match(r".*?(http://127\.0\.0\.1:(\d+)/[\w-]{32}/)\n.* --port (\d+) ", done.stdout)
    assert found
    assert found[2] == found[3]
    assert (len(done.stderr.strip().splitlines()), "SIGTERM" in done.stderr) == (1, signal == "SIGTERM")
    # Started again on the same port, it has the same link; and says how a proxy has it.
    again = ["view", str(store), "--no-open", "--port", found[3], "--allow-host", "hub.example.org"]
    said = run_stopped("vla_attention.analyze", again, moment, signal=signal).stdout
    assert said.startswith(done.stdout)
    token = found[1].split("/")[3]
    assert f"https://hub.example.org/user/NAME/proxy/{found[3]}/{token}/" in said
