"""What the writer takes of policies and loops that are not ours, and what it refuses; `verify` reports the same."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from msgspec import structs

from tests.kit.site_stores import SiteStoreSpec, site_records, site_root, write_site_store
from vla_attention.capture.store.episode_writer import EpisodeWriter, ReplanRefused
from vla_attention.capture.store.replan_records import ReplanRecord
from vla_attention.capture.store.store_writer import open_run
from vla_attention.schemas.layout import SiteLayout, prompt_at
from vla_attention.schemas.stores.reader import open_store
from vla_attention.schemas.stores.verify import verify_store

Change = Callable[[ReplanRecord], ReplanRecord]


def move_mass(site: str, key: int, query: int | None = None) -> Change:
    """Give a key the mass of the key with the largest one."""

    def change(record: ReplanRecord) -> ReplanRecord:
        rows = record.rows[site].rows.copy()
        part = rows if query is None else rows[..., query, :]
        part[..., key] += part[..., 0]
        part[..., 0] = 0.0
        return replace(record, rows=record.rows | {site: replace(record.rows[site], rows=rows, contribution=None)})

    return change


def append(path: Path, spec: SiteStoreSpec, changes: dict[int, Change]) -> None:
    store = open_run(path, site_root(spec), "new", durable=False)
    start, records = site_records(spec, 0, 0)
    with store.episode(start, np.array([1.0, 0.5])) as writer:
        for replan, record in enumerate(records):
            writer.append(changes[replan](record) if replan in changes else record)
        writer.commit(success=None, num_steps=0)


@pytest.mark.parametrize(
    ("spec", "changes", "named"),
    [
        (
            SiteStoreSpec(kind="growing", contributions=False),
            {1: move_mass("joint", 33)},
            "joint/rows .*'absent' at replan 1",
        ),
        (
            SiteStoreSpec(kind="growing", queries="all", replans=1, contributions=False),
            {0: move_mass("joint", 30, query=2)},
            "'generated' .* at replan 0, denoise step 0, layer 0, head 0, query 2",
        ),
        (
            SiteStoreSpec(),
            {1: lambda record: replace(record, state=None)},
            "state",
        ),
        (
            SiteStoreSpec(dataset_actions=0.5),
            {1: lambda record: replace(record, dataset_actions=np.zeros((3, 4)))},
            r"dataset_actions .*\(4,\),.*\(3,\)",
        ),
    ],
)
def test_replans_that_are_refused(tmp_path, spec, changes, named):
    with pytest.raises(ReplanRefused, match=named):
        append(tmp_path / "a.zarr", spec, changes)
    assert not list((tmp_path / "a.zarr" / "episodes").glob("task*"))


@pytest.mark.parametrize(
    ("spec", "changes", "named"),
    [
        (
            SiteStoreSpec(kind="growing", contributions=False),
            {1: move_mass("joint", 33)},
            "'absent' at replan 1",
        ),
        (
            SiteStoreSpec(kind="growing", queries="all", replans=1, contributions=False),
            {0: move_mass("joint", 30, query=2)},
            "'generated'",
        ),
    ],
)
def test_verify_reports_what_the_writer_let_through(tmp_path, monkeypatch, spec, changes, named):
    with monkeypatch.context() as patch:
        patch.setattr(EpisodeWriter, "_problems", lambda writer, record: iter(()))
        patch.setattr(EpisodeWriter, "_read_back", lambda writer, run: None)
        append(tmp_path / "a.zarr", spec, changes)
    (fault,) = verify_store(open_store(tmp_path / "a.zarr"))
    assert named in fault.problem


def test_arrays_that_nobody_knows_are_missing_and_no_fault(tmp_path):
    bare = SiteStoreSpec(actions=False, state=False, frames=False, contributions=False, outcome="unknown")
    store = open_store(write_site_store(tmp_path / "a.zarr", bare))
    assert verify_store(store) == []
    for episode in store.episodes:
        assert episode.attributes.success is None
        for name in ("state", "actions", "noise_seed", "dataset_actions", "frames/base"):
            assert not episode.has(name)


def test_pieces_of_the_prompt_are_at_the_same_places_of_every_sites_text(tmp_path):
    store = open_store(write_site_store(tmp_path / "a.zarr", tasks=(0,), episodes=1))
    (episode,) = store.episodes
    of_self, of_cross = (episode.tokens(store.attributes, site) for site in ("self", "cross"))
    assert of_self.prompts == of_cross.prompts
    text = store.attributes.sites[1].spans[2]
    moved = SiteLayout("text", (structs.replace(text, start=0, stop=text.num_keys),))
    sites = (store.attributes.sites[0], moved)
    (first, *_), (shifted, *_) = of_self.prompts, tuple(prompt_at(sites, moved, prompt) for prompt in of_self.prompts)
    assert [piece.key for piece in shifted.pieces] == [piece.key - 16 for piece in first.pieces]
    assert shifted.text == first.text
