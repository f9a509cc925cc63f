"""`vla-attention capture verify --repair`, and what `status` and `--resume` say of damaged episodes."""

from __future__ import annotations

import json
import os
import re
import shutil
import signal
from collections.abc import Callable
from datetime import datetime
from pathlib import Path

import pytest

from tests.kit.attacks import files_of
from tests.kit.crashes import before_call, die, run_child
from tests.kit.still_scene import capture_without_simulator
from tests.kit.stores import StoreSpec, write_store
from tests.kit.thorough import thorough_except
from vla_attention.analyze.__main__ import main as analyze
from vla_attention.capture.__main__ import main
from vla_attention.capture.jobs.status import store_status
from vla_attention.schemas.errors import plural
from vla_attention.schemas.stores.locks import Locks, episode_locks
from vla_attention.schemas.stores.reader import open_store
from vla_attention.schemas.stores.repair import damaged_folder, repair_store
from vla_attention.schemas.stores.store_format import StoreError
from vla_attention.schemas.stores.verify import verify_store
from vla_attention.schemas.stores.worker import Worker

SPEC = StoreSpec(tasks=(0, 2), episodes=2, replans=1, layers=(0,), heads=(0,), frames=False)
DAMAGED, WHOLE = "task000_episode001", ["task000_episode000", "task002_episode000", "task002_episode001"]
NODE = Worker("node7-11-ab", "node7", 11, "1", "pid:[1]", "99", "98_2", 0)


def chunk(episode: Path, array: str) -> Path:
    return next(iter(files_of(episode, array)))


def empty(episode: Path) -> None:
    shutil.rmtree(episode)
    episode.mkdir()


def other_name(episode: Path) -> None:
    shutil.rmtree(episode)
    shutil.copytree(episode.with_name(WHOLE[0]), episode)


#: What happens to an episode, and what a cheap look names.
DAMAGE: dict[str, tuple[Callable[[Path], object], str]] = {
    "emptied": (empty, "seal"),
    "lacks atoms": (lambda episode: shutil.rmtree(episode / "joint/atoms"), "joint/atoms/c.0"),
    "lacks a chunk": (lambda episode: chunk(episode, "joint/rows").unlink(), "joint/rows/c.0"),
    "cut off": (lambda episode: os.truncate(chunk(episode, "joint/rows"), 20), " 20 bytes"),
    "no attributes": (lambda episode: (episode / "zarr.json").unlink(), "zarr.json"),
    "edited attributes": (
        lambda episode: (episode / "zarr.json").write_text((episode / "zarr.json").read_text().replace("bowl", "bowk")),
        "zarr.json",
    ),
    "a copy of another": (other_name, "task000_episode000"),
}


def files(folder: Path) -> dict[str, bytes]:
    return {str(file.relative_to(folder)): file.read_bytes() for file in folder.rglob("*") if file.is_file()}


@pytest.fixture(scope="module")
def original(tmp_path_factory) -> Path:
    return write_store(tmp_path_factory.mktemp("original") / "a.zarr", spec=SPEC)


@pytest.fixture
def store(original, tmp_path) -> Path:
    shutil.copytree(original, tmp_path / "a.zarr")
    return tmp_path / "a.zarr"


@pytest.fixture
def episode(store) -> Path:
    return store / "episodes" / DAMAGED


def names(store: Path) -> list[str]:
    return [found.name for found in open_store(store).episodes]


@pytest.mark.parametrize("kind", thorough_except(("emptied", "lacks atoms", "cut off"), DAMAGE))
def test_a_damaged_episode_is_listed_moved_aside_and_missing(store, episode, original, capsys, kind):
    damage, named = DAMAGE[kind]
    damage(episode)
    remains = files(episode)

    assert main(["status", str(store), "--expected", "2", "--check"]) == 1
    printed = capsys.readouterr().out
    assert "0     1 of 2    " in printed
    assert DAMAGED in printed
    assert named in printed
    assert "missing" not in printed
    assert f"vla-attention capture verify {store} --repair" in printed

    assert main(["verify", str(store), "--repair", "--quick", "--dry-run"]) == 1
    printed = capsys.readouterr().out
    assert f"{store}: 1 of 4 " in printed
    assert named in printed
    assert names(store) == sorted([*WHOLE, DAMAGED])
    assert list(store.parent.iterdir()) == [store]

    assert main(["verify", str(store), "--repair", "--quick"]) == 0
    printed = capsys.readouterr().out
    assert named in printed
    assert "--resume" in printed
    (entry,) = damaged_folder(store).iterdir()
    assert str(entry) in printed
    assert files(entry / DAMAGED) == remains
    reason = json.loads((entry / "reason.json").read_text())
    assert (reason["episode"], reason["store"]) == (DAMAGED, "a.zarr")
    assert named in " ".join(reason["problems"])
    assert datetime.fromisoformat(reason["moved_at"]).tzinfo is not None

    assert names(store) == WHOLE
    assert verify_store(open_store(store)) == []
    assert [task.missing for task in store_status(store, expected=2).tasks] == [[1], []]
    assert sorted(path.name for path in store.parent.iterdir()) == ["a.zarr", "a.zarr.damaged"]  # and no logs
    assert main(["verify", str(store), "--repair", "--quick"]) == 0
    assert " 3 episodes" in capsys.readouterr().out
    write_store(store, mode="resume", spec=SPEC)
    assert files(store) == files(original)


def test_damage_that_only_reading_shows_needs_verify(store, episode, capsys):
    file = chunk(episode, "joint/rows")
    content = bytearray(file.read_bytes())
    content[30] ^= 1
    file.write_bytes(content)
    assert main(["status", str(store), "--expected", "2", "--check"]) == 0
    assert main(["verify", str(store), "--repair", "--quick"]) == 0
    assert "--quick" in capsys.readouterr().out
    assert main(["status", str(store), "--expected", "2", "--check", "--verify"]) == 1
    said = capsys.readouterr().out
    assert re.search(f"{DAMAGED} .* joint/rows", said)
    assert main(["verify", str(store), "--repair"]) == 0
    assert names(store) == WHOLE
    assert main(["verify", str(store), "--repair"]) == 0
    assert "--quick" not in capsys.readouterr().out


def test_an_episode_that_is_being_written_is_left_alone(store, episode, capsys):
    empty(episode)
    locks = episode_locks(store, NODE)
    assert locks.acquire(DAMAGED) is None
    assert main(["verify", str(store), "--repair", "--quick"]) == 1
    printed = capsys.readouterr().out
    assert re.search(r"task000_episode001 by node7 \(job 98_2\)", printed)
    assert "--resume" not in printed
    assert episode.is_dir()
    assert [holder.worker for holder in locks.holders()] == [NODE]
    locks.release(DAMAGED)
    assert main(["verify", str(store), "--repair", "--quick"]) == 0
    assert names(store) == WHOLE


@pytest.mark.parametrize("dry_run", [True, False])
@pytest.mark.parametrize("kind", ["folder", "link", "dangling link", "file"])
def test_what_is_said_to_be_removed_is_gone_and_the_rest_is_there(store, tmp_path, capsys, kind, dry_run):
    left, elsewhere = store / ".writing" / f"{DAMAGED}-0123", tmp_path / "elsewhere"
    elsewhere.mkdir()
    (elsewhere / "mine").write_text("kept")
    left.parent.mkdir()
    if kind == "folder":
        shutil.copytree(elsewhere, left)
    elif kind == "file":
        left.write_text("")
    else:
        left.symlink_to(elsewhere if kind == "link" else tmp_path / "nowhere")
    assert analyze(["store", "verify", str(store), "--repair", *["--dry-run"] * dry_run]) == 0
    line = next(line for line in capsys.readouterr().out.splitlines() if str(left) in line)
    assert "removed: " in line
    assert os.path.lexists(left) == dry_run
    assert (elsewhere / "mine").read_text() == "kept"


def test_an_episode_recorded_anew_in_the_meantime_stays(store, episode, original, monkeypatch):
    empty(episode)
    acquire = Locks.acquire

    def after_another_process(locks, name):
        shutil.rmtree(episode)
        shutil.copytree(original / "episodes" / DAMAGED, episode)
        return acquire(locks, name)

    monkeypatch.setattr(Locks, "acquire", after_another_process)
    assert repair_store(store) == []
    assert verify_store(open_store(store)) == []
    assert len(names(store)) == 4
    monkeypatch.undo()
    empty(episode)
    monkeypatch.setattr(Locks, "acquire", lambda locks, name: shutil.rmtree(episode))  # another repair was faster
    assert repair_store(store) == []


def test_a_failing_repair_harms_nothing(store, episode, monkeypatch):
    empty(episode)

    rename = Path.rename

    def refuse(source: Path, target: Path) -> None:
        if damaged_folder(store) in target.parents:
            raise PermissionError(13, "Permission denied")
        rename(source, target)

    with monkeypatch.context() as patch:
        patch.setattr(Path, "rename", refuse)
        with pytest.raises(StoreError, match=DAMAGED):
            repair_store(store)
    assert episode.is_dir()
    assert episode_locks(store).holders() == []
    monkeypatch.setattr(Locks, "acquire", lambda locks, name: refuse(store, damaged_folder(store) / name))
    with pytest.raises(StoreError):  # not even a lock can be written
        repair_store(store)
    monkeypatch.undo()
    (finding,) = repair_store(store)
    assert finding.moved_to is not None
    assert verify_store(open_store(store)) == []


def repair_and_die(store: Path, kind: str, number: int) -> None:
    with before_call(kind, number, die):
        repair_store(store)


@pytest.mark.parametrize("kind", ["rename", "renamed"])
def test_a_killed_repair_harms_nothing(store, episode, original, kind):
    empty(episode)
    assert run_child(repair_and_die, store, kind, 0) == -signal.SIGKILL
    assert [found.name for found in open_store(store).episodes if found.name != DAMAGED] == WHOLE
    repair_store(store)
    assert names(store) == WHOLE
    assert len(list(damaged_folder(store).glob(f"*/{DAMAGED}"))) == 1
    write_store(store, mode="resume", spec=SPEC)
    assert files(store) == files(original)
    assert not (store / ".writing").exists()  # the lock of the killed process does not stay


def test_resuming_records_what_is_missing_and_says_what_is_damaged(tmp_path, monkeypatch, capsys):
    capture_without_simulator(monkeypatch)
    store = tmp_path / "a.zarr"
    given = [
        "pi",
        "--checkpoint",
        "untrained-tiny",
        "--task-suite",
        "robosuite",
        "--task-id",
        "0",
        "--replan-steps",
        "4",
        "--max-steps",
        "4",
    ]
    given += ["--num-episodes", "3", "--output", str(store)]
    assert main(given) == 0
    reference = files(store)
    shutil.rmtree(store / "episodes/task000_episode000/joint/atoms")
    empty(store / "episodes/task000_episode001")
    shutil.rmtree(store / "episodes/task000_episode002")
    capsys.readouterr()
    for added in (1, 0):
        assert main([*given, "--resume"]) == 2
        said = capsys.readouterr()
        assert re.search(rf"\b{1 - added} of 3 episodes .* 2 damaged; {added} to run", said.out)
        assert f"{plural(added, 'episode')} added" in said.out
        assert "task000_episode001" in said.out
        assert re.search(rf"\b2 .* task000_episode000 .*vla-attention capture verify {store} --repair", said.err)
        assert said.err.count("\n") == 1
        assert (store / "episodes/task000_episode002").is_dir()
    assert not store_status(store).complete
    with (store / "episodes/task000_episode002/actions/c.0.0.0").open("r+b") as file:
        file.seek(30)
        file.write(b"??")
    assert main([*given, "--resume", "--verify"]) == 2
    assert "3 of the" in capsys.readouterr().err
    # An episode that was not asked for is no business of this capture.
    assert main([*given, "--resume", "--num-episodes", "1"]) == 2
    assert "1 of the" in capsys.readouterr().err
    assert main(["verify", str(store), "--repair"]) == 0
    assert main([*given, "--resume", "--verify"]) == 0
    assert files(store) == reference
    assert main([*given, "--verify"]) == 2
    assert re.search("--verify .*--resume", capsys.readouterr().err)
    assert store_status(store).complete
    assert analyze(["store", "verify", str(store)]) == 0
