"""What first maps get where objects stand, here and in other episodes, against loops over raw Zarr arrays."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import polars as pl
import pytest
import zarr

from tests.kit.bowl_scene import CAMERAS, bowl_coverage, bowl_tokens, write_bowl_store
from tests.kit.questions import question_about
from tests.kit.raw_rows import probabilities
from tests.kit.tokens import random_rows
from vla_attention.analyze.core.object_maps import look_at_maps, over_place
from vla_attention.analyze.measures.scan import scan

SIZE, REPLANS, EPISODES = 7, 2, (0, 1, 2)


def places(task: int, episode: int, tokens) -> dict[str, np.ndarray]:
    """Everything stands further to the right and below in each further episode, and in the other task.

    The last episode does not show the bowl on the wrist's camera.
    """
    moved = {}
    for camera, area in bowl_coverage(REPLANS, SIZE).items():
        grid = area.reshape(REPLANS, SIZE, SIZE, -1)
        moved[camera] = np.roll(grid, (episode + 3 * task, 2 * episode), axis=(1, 2)).reshape(area.shape)
    if episode == EPISODES[-1]:
        moved[CAMERAS[1]][..., 4] += moved[CAMERAS[1]][..., 0]
        moved[CAMERAS[1]][..., 0] = 0.0
    return moved


@pytest.fixture(scope="module")
def store(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("maps") / "a.zarr"
    return write_bowl_store(
        path,
        tokens=bowl_tokens(REPLANS, SIZE),
        episodes=len(EPISODES),
        layers=(0, 2),
        plant_coverage=places,
    )


def raw(store: Path, task: int, episode: int) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """Of each camera rows (replan, layer, denoise, head, patch), and coverage (replan, patch, item)."""
    root = zarr.open_group(store, mode="r")
    group = root[f"episodes/task{task:03d}_episode{episode:03d}"]
    rows = probabilities(group["joint/rows"]).astype(np.float64).mean(axis=4)
    spans = {span["camera"]: span for span in root.attrs["sites"][0]["spans"] if span["camera"]}
    keys = {camera: slice(spans[camera]["start"], spans[camera]["stop"]) for camera in CAMERAS}
    return {c: rows[..., keys[c]] for c in CAMERAS}, {c: group[f"objects/{c}"][:].astype(float) for c in CAMERAS}


def expected(arrays: dict, episode: int, layer: int, head: int, cameras: tuple[str, ...], thing: int) -> list[float]:
    """At the first call, by a loop over cameras and patches: in the episode, and in the other episodes of the task."""
    first = {camera: of[0, layer, :, head].mean(axis=0) for camera, of in arrays[episode][0].items()}
    others = [other for other in EPISODES if other != episode]
    found = []
    for shown in ([episode], others):
        on, even = 0.0, 0.0
        for camera in cameras:
            share = first[camera].sum() / sum(first[other].sum() for other in CAMERAS)
            area = np.mean([arrays[other][1][camera][0, :, thing] for other in shown], axis=0)
            on += sum(share * first[camera][patch] / first[camera].sum() * area[patch] for patch in range(SIZE * SIZE))
            even += share * area.mean()
        found.append(on / even)
    return found


def test_it_is_what_the_maps_get_at_the_places_of_the_other_episodes(store):
    question = question_about(store)
    (found,) = scan(question, [look_at_maps(question, heads=True, layers=True, iou=False)])
    table = over_place(question, found)
    arrays = {task: [raw(store, task, episode) for episode in EPISODES] for task in (0, 1)}
    things = [thing.name for thing in question.selected[0].tokens.objects]
    own = table.filter(kind="object").filter(pl.col("layer") != "layers_avg")
    maps = 2 * 2 * 2  # of a task, layer and head
    assert own.height == maps * (len(EPISODES) * (1 + len(CAMERAS)) * len(things) - 1)
    assert own.filter(episode_index=EPISODES[-1], camera=CAMERAS[1], item=things[0]).is_empty()
    for row in own.iter_rows(named=True):
        cameras = CAMERAS if row["camera"] == "all" else (row["camera"],)
        at = (row["episode_index"], (0, 2).index(int(row["layer"])), row["head"])
        wanted = expected(arrays[row["task_id"]], *at, cameras, things.index(row["item"]))
        assert [row["at_place"], row["elsewhere"]] == pytest.approx(wanted, rel=1e-5), row


def test_the_same_episode_three_times_has_exactly_its_place(tmp_path):
    def plant(task, episode, tokens, rows):
        rows = random_rows(tokens, rows.shape[1:-1], seed=task, spread=1.0)
        return rows / rows.sum(axis=-1, keepdims=True)

    path = write_bowl_store(tmp_path / "a.zarr", tokens=bowl_tokens(REPLANS, SIZE), episodes=3, plant_rows=plant)
    question = question_about(path)
    (found,) = scan(question, [look_at_maps(question, heads=False, layers=False, iou=False)])
    table = over_place(question, found)
    assert table.height > 0
    assert (table["at_place"] == table["elsewhere"]).all()
