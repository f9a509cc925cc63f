"""What the page shows of a store is what Python computes: ratios, masses, patches, words, heads, pixels.

The page's own script reads the golden stores over HTTP ranges, as a browser does, folders and zips.
"""

from __future__ import annotations

import math
import shutil
from pathlib import Path
from typing import Any
from urllib.parse import parse_qs

import numpy as np
import polars as pl
import pytest
from matplotlib import colormaps

import vla_attention as va
from tests.analyze.view.page_answers import PageQuestion, needs_node, page_answers
from tests.end_to_end.test_cameras_of_several_spans import write_spans_store
from tests.kit.golden_stores import FOLDER
from tests.kit.http_ranges import serve
from vla_attention.analyze.core.camera_maps import (
    NO_PICTURE,
    camera_names,
    enlarge,
    episode_maps,
    scale_end,
    stored_picture,
    upright,
)
from vla_attention.analyze.measures.question import ask
from vla_attention.analyze.measures.question_settings import settings_from_keywords
from vla_attention.analyze.stores.rows import layer_rows

pytestmark = needs_node
#: Sums are of float32 in another order.
CLOSE = 2e-6
QUERIES = {
    "joint": ("", "?layer=1&denoise=2&head=3&replan=2", "?layer=2&replan=1&measure=raw&smooth=1"),
    "cosmos": ("?site=cross&replan=1", "?site=self&layer=1&head=1&measure=rank"),
    "spans": ("", "?layer=2&measure=raw&replan=1&smooth=1"),
    "packed": ("?layer=1&replan=2",),
}
CASES = [(f"version2/{name}", query) for name, queries in QUERIES.items() for query in queries]


@pytest.fixture(scope="module")
def stores(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the golden stores, and one of a camera with tiles, a thumbnail and pooled tokens."""
    folder = tmp_path_factory.mktemp("stores")
    shutil.copytree(FOLDER.parent / "version2", folder / "version2")
    write_spans_store(folder / "version2" / "spans.zarr", "tiles and thumbnail")
    return folder


@pytest.fixture(scope="module")
def answers(stores: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[tuple[str, str], dict[str, Any]]:
    with serve(stores) as served:
        questions = [
            PageQuestion(
                f"{served.url}/{name.partition('/')[0]}/",
                f"{name.partition('/')[2]}.zarr/",
                query=query,
                packed=name.endswith("packed"),
            )
            for name, query in CASES
        ]
        found = page_answers(tmp_path_factory.mktemp("page"), questions)
    assert [answer.get("failure") for answer in found] == [None] * len(CASES)
    return dict(zip(CASES, found, strict=True))


def settings_of(query: str, site: str) -> tuple[dict[str, Any], int]:
    """What a link's query asks of the analysis, and its replan."""
    link = {name: values[0] for name, values in parse_qs(query.removeprefix("?")).items()}
    names = {"layer": "layers", "head": "heads", "denoise": "denoise"}
    return {"site": site, **{names[axis]: int(link[axis]) for axis in names if axis in link}}, int(
        link.get("replan", 0)
    )


each_case = pytest.mark.parametrize(("name", "query"), CASES)


@each_case
def test_ratio_and_masses_of_every_replan(answers, stores, name, query):
    answer = answers[name, query]
    run = va.open(stores / f"{name}.zarr")
    asked, _ = settings_of(query, answer["site"])
    which = (pl.col("task_id") == 0) & (pl.col("episode_index") == 0)
    mean = pl.col("layer") == "layers_avg"
    masses = run.analyze(grouping="default", **asked)["replans_groups"].filter(which & mean)
    for replan, shown in enumerate(answer["replans"]):
        rows = masses.filter(replan=replan)
        assert rows["group"].to_list() == list(shown["groups"])
        for row in rows.iter_rows(named=True):
            expected = [
                row[column] if row[column] is not None else math.nan for column in ("mass", "fraction", "keys", "lift")
            ]
            np.testing.assert_allclose(
                [float(value) for value in shown["groups"][row["group"]]], expected, rtol=CLOSE, atol=1e-12
            )
    ratios = run.analyze(grouping="default", **asked)["replans"].filter(which & mean)
    if "ratio" not in ratios.columns or ratios["ratio"].is_null().all():
        assert answer["replans"][0]["ratio"] is None
        return
    shown = np.array([replan["ratio"] for replan in answer["replans"]], dtype=float)
    np.testing.assert_allclose(shown, ratios.select("ratio", "uniform_ratio", "ratio_lift").to_numpy(), rtol=CLOSE)


@each_case
def test_the_lift_of_every_head(answers, stores, name, query):
    answer = answers[name, query]
    run = va.open(stores / f"{name}.zarr")
    asked, replan = settings_of(query, answer["site"])
    asked = {field: value for field, value in asked.items() if field in ("site", "denoise")}
    mine = (pl.col("task_id") == 0) & (pl.col("episode_index") == 0) & (pl.col("replan") == replan)
    masses = run.analyze(grouping="default", per_head=True, **asked)["steps_groups"].filter(mine)
    cells = run.analyze(grouping="default", per_head=True, **asked)["steps"].filter(mine)
    cell = ["layer", "head"]
    valid = cells.group_by(cell, maintain_order=True).agg(pl.col("valid_mass").mean() / pl.col("num_valid").first())
    of_groups = masses.group_by([*cell, "group"], maintain_order=True).agg(
        pl.col("mass", "keys").mean(), pl.col("lift").is_not_null().any().alias("seen")
    )
    joined = of_groups.join(valid, on=cell, maintain_order="left")
    expected = joined.select(
        pl.when((pl.col("keys") > 0) & pl.col("seen")).then(pl.col("mass") / pl.col("keys") / pl.col("valid_mass"))
    )
    shown = [float(value) for layer in answer["cells"] for head in layer for value in head.values()]
    np.testing.assert_allclose(shown, expected.to_series().fill_null(math.nan).to_numpy(), rtol=CLOSE, atol=1e-12)


@each_case
def test_rows_patches_words_and_their_readers(answers, stores, name, query):
    answer = answers[name, query]
    asked, replan = settings_of(query, answer["site"])
    question = ask(
        va.open(stores / f"{name}.zarr").stores,
        settings_from_keywords(grouping="default", per_head=True, **asked),
    )
    item = question.selected[0]
    read = layer_rows(item.store.attributes, item.episode, question.selection, answer["site"])
    parts = [(part.layer, part.rows[replan].astype(np.float64)) for part in read]
    by_head = np.zeros((len(question.selection.layers), *parts[0][1].shape))  # (layer, head, key)
    for layer, rows in parts:
        by_head[layer] += rows / len(question.selection.denoise)
    mean = by_head.mean(axis=(0, 1))
    np.testing.assert_allclose(answer["row"], mean, rtol=CLOSE, atol=1e-12)
    valid = np.broadcast_to(item.valid, (item.tokens.num_replans, len(mean)))[replan]
    uniform = mean[valid].sum() / np.broadcast_to(item.num_valid, item.tokens.num_replans)[replan]
    prompts = item.tokens.words
    words = prompts[item.tokens.prompt_index[replan]] if prompts else ()
    assert [(word["text"], tuple(word["keys"])) for word in answer["words"]] == [
        (word.text, word.keys) for word in words
    ]
    for shown, word in zip(answer["words"], words, strict=True):
        mass = mean[list(word.keys)].sum()
        np.testing.assert_allclose([shown["mass"], shown["lift"]], [mass, mass / len(word.keys) / uniform], rtol=CLOSE)
    if words and "head" not in query:  # where one head is chosen, the others of its layer are looked at, too
        heads = by_head[..., list(words[0].keys)].sum(axis=-1)
        best = np.sort(heads.ravel())[::-1][:3]
        np.testing.assert_allclose([reader["mass"] for reader in answer["readers"]], best, rtol=CLOSE)


def in_inferno(frame: np.ndarray | None, values: np.ndarray, smooth: bool, shape: tuple[int, ...]) -> np.ndarray:
    """What the page draws: a third of the picture's colour, and on it inferno, the denser the higher, 3 at the end."""
    picture = np.full((*shape[:2], 3), NO_PICTURE, dtype=float) if frame is None else frame.astype(float)
    grey = (picture @ np.array([0.299, 0.587, 0.114]))[..., None]
    place = np.clip(enlarge(values, shape[0], shape[1], smooth) / 3.0, 0.0, 1.0)
    opacity = np.nan_to_num(0.8 * place)[..., None]
    colours = 255 * colormaps["inferno"](np.nan_to_num(place))[..., :3]
    return np.clip(np.round((1 - opacity) * (0.35 * picture + 0.65 * grey) + opacity * colours), 0, 255)


@each_case
def test_pictures_have_the_attention_of_their_patches_in_inferno(answers, stores, name, query):
    answer = answers[name, query]
    if not answer["cameras"]:
        assert answer["site"] == "cross"
        return
    asked, replan = settings_of(query, answer["site"])
    question = va.open(stores / f"{name}.zarr").ask(grouping="default", **asked)
    maps = episode_maps(question, question.selected[0], camera_names(question))
    assert [camera["camera"] for camera in answer["cameras"]] == list(maps.cameras)
    for camera in answer["cameras"]:
        values = np.array(camera["values"], dtype=float)
        one = maps.cameras[camera["camera"]]
        lift, mass = one.lift[replan], one.mass[replan]
        measure = parse_qs(query.removeprefix("?")).get("measure", ["lift"])[0]
        if measure == "lift":
            np.testing.assert_allclose(values, lift.ravel(), rtol=CLOSE)
            np.testing.assert_allclose(camera["high"], scale_end(lift))
        elif measure == "raw":
            np.testing.assert_allclose(values, 100 * mass.ravel(), rtol=CLOSE)
        else:
            assert (np.argsort(values, kind="stable") == np.argsort(mass.ravel(), kind="stable")).all()
        shape = (camera["height"], camera["width"], 4)
        pixels = np.array(camera["pixels"], dtype=np.uint8).reshape(shape)[..., :3]
        frame = stored_picture(question.selected[0], one.view.name, replan)
        turned = in_inferno(frame, upright(values.reshape(lift.shape), one.view), "smooth=1" in query, shape)
        # The page has colours of whole numbers, and a value at the border of two of the 256 may have either.
        difference = np.abs(pixels.astype(int) - turned.astype(int))
        assert difference.max() <= 4
        assert (difference <= 1).mean() > 0.99
