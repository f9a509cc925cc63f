"""Several looks in one scan find what each finds alone, from rows and from the cache."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.kit.questions import question_about
from tests.kit.stores import StoreSpec, write_store
from vla_attention.analyze.core.camera_maps import episode_maps
from vla_attention.analyze.core.labelled_arrays import rows_of_episodes
from vla_attention.analyze.core.levels import look_at_groups
from vla_attention.analyze.core.measure import look_at
from vla_attention.analyze.core.recorded_effects import selected_items
from vla_attention.analyze.core.word_items import items_of
from vla_attention.analyze.measures import scan as module
from vla_attention.analyze.measures.question import Question
from vla_attention.analyze.measures.scan import Look, OnDisk, scan
from vla_attention.schemas.errors import BadArgument

#: Seven heads and all queries: means of means would differ in the last bits.
SPEC = StoreSpec(
    tasks=(0, 1), episodes=2, replans=5, prompts="same", frames=False, heads=tuple(range(7)), queries="all"
)


@pytest.fixture
def question(tmp_path: Path) -> Question:
    return question_about(write_store(tmp_path / "a.zarr", spec=SPEC), groups=("bowl=word:bowl", "rest=*"))


@pytest.fixture
def scanned(monkeypatch: pytest.MonkeyPatch) -> list[tuple[str, int]]:
    """(episode, number of its looks) of the episodes that are read from now on."""
    found: list[tuple[str, int]] = []
    one = module._scanned

    def watched(given: Any, **settings: Any) -> Any:
        found.append((given[0].episode.name, len(given[1])))
        return one(given, **settings)

    monkeypatch.setattr(module, "_scanned", watched)
    return found


def looks_of(question: Question) -> list[Look[Any]]:
    corner = partial(selected_items, selectors=("patch:base_0_rgb[0:1,0:2]", "word:the"))
    return [
        look_at_groups(question, heads=True),
        look_at(question, items_of),
        look_at(question, corner, ("head",), positions=(1, 3)),
    ]


def same(one: Any, other: Any) -> bool:
    arrays = ("mass", "whole", "valid", "keys", "uniform", "row_sum", "num_valid")
    return all(np.array_equal(getattr(one, name), getattr(other, name)) for name in arrays)


def test_looks_together_find_what_each_finds_alone(question, scanned, monkeypatch):
    monkeypatch.setenv("VLA_CACHE", "off")
    together = scan(question, looks_of(question))
    assert [count for _, count in scanned] == [2, 3, 2, 3]
    assert [len(found) for found in together] == [4, 4, 2]
    for found, look in zip(together, looks_of(question), strict=True):
        assert all(map(same, found, scan(question, [look])[0]))
    assert [one.item.episode.name for one in together[2]] == [question.selected[i].episode.name for i in (1, 3)]


def test_what_one_look_has_in_the_cache_is_not_read_for_it(question, scanned, monkeypatch, tmp_path):
    monkeypatch.setenv("VLA_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr("vla_attention.analyze.cache.remembered.SETTLED_SECONDS", 0.0)
    words = scan(question, looks_of(question)[1:2])[0]
    scanned.clear()
    together = scan(question, looks_of(question))
    assert [count for _, count in scanned] == [1, 2, 1, 2]
    assert all(map(same, together[1], words))
    scanned.clear()
    again = scan(question, looks_of(question))
    assert scanned == []
    assert all(all(map(same, *pair)) for pair in zip(again, together, strict=True))


def test_nothing_that_was_read_of_an_episode_stays(question, monkeypatch):
    monkeypatch.setenv("VLA_CACHE", "off")
    scan(question, looks_of(question))
    assert len(list(rows_of_episodes(question))) == 4
    for item in question.selected:
        episode_maps(question, item, ("base_0_rgb",))
        assert not vars(item.episode).get("_kept")


def test_members_lie_on_disk_and_are_made_at_every_access(monkeypatch, tmp_path):
    found = OnDisk[tuple[int, list[int]]](lambda position, content: (position, content), (4, 7))
    for content in ([1], [2, 3]):
        found.append(content)
    assert list(found) == [(4, [1]), (7, [2, 3])]
    assert found[1] is not found[1]
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "nowhere"))
    with pytest.raises(BadArgument, match="TMPDIR"):
        OnDisk()
