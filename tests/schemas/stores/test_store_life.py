"""The life of stores, against a model in memory: written, killed, damaged, verified, repaired, merged, copied, read."""

from __future__ import annotations

import functools
import os
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, settings
from hypothesis import strategies as st
from hypothesis.stateful import (
    RuleBasedStateMachine,
    initialize,
    invariant,
    precondition,
    rule,
    run_state_machine_as_test,
)

from tests.kit.attacks import files_of
from tests.kit.crashes import before_call, die, run_child
from tests.kit.examples import examples
from tests.kit.stores import StoreSpec, expected_arrays, root_attributes, write_episode
from vla_attention.analyze.store.copying import copy_store
from vla_attention.analyze.store.merging import merge_stores
from vla_attention.capture.store.store_writer import open_run
from vla_attention.schemas.errors import BadArgument
from vla_attention.schemas.stores.locks import store_locks
from vla_attention.schemas.stores.reader import open_store
from vla_attention.schemas.stores.repair import damaged_folder, repair_store
from vla_attention.schemas.stores.store_format import CorruptEpisode, StoreExists, episode_name
from vla_attention.schemas.stores.verify import episode_report, store_faults

SPEC = StoreSpec(tasks=(0,), episodes=3, replans=1, layers=(0,), heads=(0,), frames=False)
EPISODES = range(3)
STORES = ("a.zarr", "b.zarr")


@functools.cache
def expected(episode: int) -> dict[str, np.ndarray]:
    return expected_arrays(SPEC, task=0, episode=episode)


def rows_of(store: Path, episode: int) -> Path:
    (file,) = files_of(store / "episodes" / episode_name(0, episode), "joint/rows")
    return file


def flip(store: Path, episode: int) -> None:
    file = rows_of(store, episode)
    content = bytearray(file.read_bytes())
    content[len(content) // 3] ^= 4
    file.write_bytes(content)


def edit(store: Path, episode: int) -> None:
    file = store / "episodes" / episode_name(0, episode) / "zarr.json"
    file.write_text(file.read_text().replace("bowl", "bowk"))


#: What happens to an episode's files, and whether a look at seal, metadata and sizes shows it.
DAMAGE: dict[str, tuple[Callable[[Path, int], object], bool]] = {
    "flip": (flip, False),
    "edit": (edit, True),
    "cut": (lambda store, episode: os.truncate(rows_of(store, episode), 20), True),
    "lose": (lambda store, episode: rows_of(store, episode).unlink(), True),
}


def write(path: Path, episode: int) -> None:
    write_episode(open_run(path, root_attributes(SPEC), "resume", durable=False), SPEC, 0, episode)


def repair(path: Path, verify: bool) -> None:
    repair_store(path, verify=verify)


def copy(path: Path, target: Path) -> None:
    copy_store(open_store(path), target, ())


def merge(one: Path, other: Path, target: Path) -> None:
    merge_stores([open_store(one), open_store(other)], target)


def act_and_die(kind: str, number: int, act: Callable[..., None], *arguments: object) -> None:
    """In a process of its own: killed at the number-th call of a kind, if it comes to that."""
    with before_call(kind, number, die):
        act(*arguments)


class StoreLife(RuleBasedStateMachine):
    """Two stores of one run, their copies and what is merged of them.

    `model`: for every store its episodes, each with the damage that was done to it, or None.
    """

    stores = st.sampled_from(STORES)
    episodes = st.sampled_from(EPISODES)
    kinds = st.sampled_from(["rename", "renamed"])
    numbers = st.integers(0, 3)

    @initialize()
    def begin(self) -> None:
        self.folder = Path(os.environ["PYTEST_STATE_FOLDER"]) / os.urandom(6).hex()
        self.folder.mkdir()
        self.model: dict[str, dict[int, str | None]] = {}
        for name in STORES:
            open_run(self.folder / name, root_attributes(SPEC), "new", durable=False)
            self.model[name] = {}
        # Neither empty nor with a common episode: so they can be merged at once.
        for name, episode in zip(STORES, (0, 2), strict=True):
            self.write(name, episode)

    @rule(store=stores, episode=episodes)
    def write(self, store: str, episode: int) -> None:
        if episode in self.model[store]:
            with pytest.raises(StoreExists):
                write(self.folder / store, episode)
        else:
            write(self.folder / store, episode)
            self.model[store][episode] = None
        assert not store_locks(self.folder / store).folder.exists()

    @rule(store=stores, episode=episodes, kind=kinds, number=numbers)
    def die_writing(self, store: str, episode: int, kind: str, number: int) -> None:
        before = dict(self.model[store])
        if episode not in before:
            run_child(act_and_die, kind, number, write, self.folder / store, episode)
            listed = self.listed(store)
            assert set(before) <= listed <= {*before, episode}
            self.model[store] = before | dict.fromkeys(listed - set(before))

    @precondition(lambda self: self.undamaged())
    @rule(data=st.data())
    def damage(self, data: st.DataObject) -> None:
        store, episode = data.draw(st.sampled_from(self.undamaged()))
        damage = data.draw(st.sampled_from(sorted(DAMAGE)))
        DAMAGE[damage][0](self.folder / store, episode)
        self.model[store][episode] = damage

    @rule(data=st.data(), quick=st.booleans())
    def verify(self, data: st.DataObject, quick: bool) -> None:
        store = data.draw(st.sampled_from(sorted(self.model)))
        opened = open_store(self.folder / store)
        found = {
            episode.name
            for episode in opened.episodes
            if episode_report(opened, episode, "quick" if quick else "files").problems
        }
        assert found == {episode_name(0, number) for number in self.damaged(store, quick)}
        assert not list(store_faults(opened))

    @rule(data=st.data(), verify=st.booleans())
    def repair(self, data: st.DataObject, verify: bool) -> None:
        store = data.draw(st.sampled_from(sorted(self.model)))
        damaged = self.damaged(store, not verify)
        kept = self.kept_aside(store)
        findings = repair_store(self.folder / store, verify=verify)
        assert [finding.damaged.name for finding in findings] == [episode_name(0, number) for number in damaged]
        assert all(finding.moved_to is not None for finding in findings)
        assert self.kept_aside(store) == kept + len(damaged)
        for number in damaged:
            del self.model[store][number]

    @rule(data=st.data(), verify=st.booleans(), kind=kinds, number=numbers)
    def die_repairing(self, data: st.DataObject, verify: bool, kind: str, number: int) -> None:
        store = data.draw(st.sampled_from(sorted(self.model)))
        before, kept = self.model[store], self.kept_aside(store)
        run_child(act_and_die, kind, number, repair, self.folder / store, verify)
        listed = self.listed(store)
        gone = set(before) - listed
        assert listed <= set(before)
        assert gone <= set(self.damaged(store, not verify))
        assert self.kept_aside(store) == kept + len(gone)
        self.model[store] = {number: damage for number, damage in before.items() if number in listed}

    @rule(store=stores)
    def copy(self, store: str) -> None:
        target = f"copy_{store}"
        there = {number: damage for number, damage in self.model.get(target, {}).items() if damage != "cut"}
        damaged = [number for number in self.damaged(store, False) if number not in there]
        if damaged:
            with pytest.raises(CorruptEpisode, match=episode_name(0, damaged[0])):
                copy(self.folder / store, self.folder / target)
        else:
            copy(self.folder / store, self.folder / target)
        until = damaged[0] if damaged else len(EPISODES)
        self.model[target] = there | {number: None for number in self.model[store] if number < until}
        assert not store_locks(self.folder / target).folder.exists()

    @rule(store=stores, kind=kinds, number=numbers)
    def die_copying(self, store: str, kind: str, number: int) -> None:
        target = f"copy_{store}"
        if self.damaged(store, False) or any(self.model.get(target, {}).values()):
            return
        run_child(act_and_die, kind, number, copy, self.folder / store, self.folder / target)
        if (self.folder / target).exists():
            listed = self.listed(target)
            assert set(self.model.get(target, ())) <= listed <= {*self.model.get(target, ()), *self.model[store]}
            self.model[target] = dict.fromkeys(listed)
        store_locks(self.folder / target).sweep()

    @rule(die=st.booleans(), kind=kinds, number=numbers)
    def merge(self, die: bool, kind: str, number: int) -> None:
        one, other = (self.folder / name for name in STORES)
        target = self.folder / "merged.zarr"
        shared = set(self.model[STORES[0]]) & set(self.model[STORES[1]])
        damaged = [number for name in STORES for number in self.damaged(name, False)]
        if shared or damaged:
            with pytest.raises(BadArgument if shared else CorruptEpisode, match=r"task000_episode00\d"):
                merge(one, other, target)
            assert not target.exists()
            return
        if die:
            run_child(act_and_die, kind, number, merge, one, other, target)
        else:
            merge(one, other, target)
            assert not store_locks(target).folder.exists()
        if target.exists():
            self.model[target.name] = self.model[STORES[0]] | self.model[STORES[1]]
            self.check(target.name)
            # Its files are those of the two stores: what is done to these is done to it.
            shutil.rmtree(target)
            del self.model[target.name]
        else:
            assert die
        store_locks(target).sweep()

    @invariant()
    def every_store_is_what_the_model_says(self) -> None:
        for store in getattr(self, "model", ()):
            self.check(store)

    def check(self, store: str) -> None:
        """What is listed, and every number of the undamaged episodes; a damaged one gives no number of the damage."""
        assert self.listed(store) == set(self.model[store])
        for episode in open_store(self.folder / store).episodes:
            number = int(episode.name[-3:])
            damage = self.model[store][number]
            if damage not in (None, "edit"):  # the seal repeats what was edited
                with pytest.raises(CorruptEpisode, match=episode.name):
                    episode.read("joint/rows")
            else:
                for name, values in expected(number).items():
                    assert episode.read(name).tobytes() == values.tobytes(), (store, episode.name, name)

    def listed(self, store: str) -> set[int]:
        return {int(episode.name[-3:]) for episode in open_store(self.folder / store).episodes}

    def damaged(self, store: str, quick: bool) -> list[int]:
        found = {number: damage for number, damage in self.model[store].items() if damage is not None}
        return sorted(number for number, damage in found.items() if DAMAGE[damage][1] or not quick)

    def undamaged(self) -> list[tuple[str, int]]:
        return [(store, number) for store, held in self.model.items() for number, damage in held.items() if not damage]

    def kept_aside(self, store: str) -> int:
        return len(list(damaged_folder(self.folder / store).glob("*/task*")))


def test_the_life_of_stores(tmp_path, monkeypatch):
    monkeypatch.setenv("PYTEST_STATE_FOLDER", str(tmp_path))
    run_state_machine_as_test(
        StoreLife,
        settings=settings(
            max_examples=examples(5), stateful_step_count=15, deadline=None, suppress_health_check=list(HealthCheck)
        ),
    )
