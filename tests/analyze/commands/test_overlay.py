"""`vla-attention overlay` on stores made by the real writer: numbers from raw arrays, pictures, a planted follower, bad
input.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import polars as pl
import pytest
import zarr
from msgspec.structs import replace

import tests.kit.stores as kit
from tests.kit.questions import question_about
from tests.kit.raw_rows import probabilities
from vla_attention.analyze.__main__ import main
from vla_attention.analyze.commands.overlay import overlay
from vla_attention.analyze.core.camera_maps import choose_episodes
from vla_attention.analyze.render.figures import draw
from vla_attention.analyze.render.pictures import lit
from vla_attention.analyze.render.style import Style
from vla_attention.analyze.render.video import _film
from vla_attention.capture.store.store_writer import open_run
from vla_attention.schemas.groupings.vocabulary import EpisodeTokens
from vla_attention.schemas.layout import Role
from vla_attention.schemas.stores.reader import open_store
from vla_attention.schemas.stores.store_format import PolicyCameraView

CAMERA = "base_0_rgb"


def place_of(replan: int) -> tuple[int, int]:
    """Where the followed thing is in the stored picture of `base_0_rgb`, which has 3 x 4 patches."""
    return (replan * 2 + 1) % 3, (replan + 2) % 4


def follow(task: int, episode: int, tokens: EpisodeTokens, rows: np.ndarray) -> np.ndarray:
    (span,) = tokens.layout.camera_spans(CAMERA)
    for replan in range(len(rows)):
        row, column = place_of(replan)
        rows[replan][..., span.start + 4 * row + column] = 3.0
    return rows / rows.sum(axis=-1, keepdims=True)


def write_turned_store(path: Path, upright: bool, mirrored: bool) -> Path:
    """One episode whose frames are black but for a white patch that attention follows."""
    spec = kit.StoreSpec(tasks=(0,), episodes=1, plant_rows=follow)
    root = kit.root_attributes(spec)
    views = tuple(replace(view, upright=upright, mirrored=mirrored) for view in root.policy.cameras)
    store = open_run(path, replace(root, policy=replace(root.policy, cameras=views)), "new")
    start, records = kit.episode_records(spec, 0, 0)
    for replan, record in enumerate(records):
        row, column = place_of(replan)
        frame = record.frames[CAMERA]
        frame[:] = 0
        frame[row * 4 : row * 4 + 4, column * 4 : column * 4 + 4] = 255
    with store.episode(start, kit.denoise_times(spec)) as writer:
        for record in records:
            writer.append(record)
        kit.commit(writer, spec, 0, 0)
    return path


@pytest.mark.parametrize("upright", [True, False])
@pytest.mark.parametrize("mirrored", [True, False])
def test_the_follower_s_attention_is_drawn_on_what_it_follows(tmp_path: Path, upright: bool, mirrored: bool) -> None:
    store = open_store(write_turned_store(tmp_path / "a.zarr", upright, mirrored))
    result = overlay(question_about(store))
    (figure,) = result.figures
    rows = figure.frame.filter(camera=CAMERA)
    assert rows["replan"].to_list() == [0, 1, 2]
    view = PolicyCameraView(CAMERA, "agentview", upright, mirrored)
    name = store.episodes[0].name
    for row in rows.iter_rows(named=True):
        frame = zarr.open_array(store.path / f"episodes/{name}/frames/{CAMERA}", mode="r")[row["replan"]]
        seen = frame[:, :, 0] == 255
        seen = seen if view.upright else seen[::-1]
        seen = seen[:, ::-1] if view.mirrored else seen
        drawn = lit(figure.options["picture"](row), np.array(row["map"]), figure.options["high"], smooth=False)
        # The followed patch alone is as white as it was.
        np.testing.assert_array_equal(drawn[..., 0] > 250, seen)
    assert result.findings[0].numbers["camera"] == CAMERA


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("overlay") / "made.zarr"
    return kit.write_store(path, episodes=2, replans=4, plant_rows=follow)


@pytest.mark.drawn
def test_the_tables_have_the_raw_rows_numbers(made: Path, tmp_path: Path) -> None:
    words = [
        "--task",
        "1",
        "--episode",
        "1",
        "--replans",
        "3",
        "1",
        "--layers",
        "2",
        "--heads",
        "1",
        "--denoise",
        "last",
        "--pdf",
    ]
    outline = f"spot=patch:{CAMERA}[0:1,0:2]"
    assert main(["overlay", str(made), *words, "--output", str(tmp_path), "--outline", outline]) == 0
    name = "overlay_task001_episode001"
    tables = {"overlay.parquet", "overlay_patches.parquet", "result.json"}
    assert {path.name for path in tmp_path.iterdir()} == {f"{name}.png", f"{name}.pdf", *tables}
    table, shown = (pl.read_parquet(tmp_path / f"overlay{end}.parquet") for end in ("_patches", ""))
    group = zarr.open_group(made / "episodes/task001_episode001", mode="r")
    rows = probabilities(group["joint/rows"])[:, 1, 1, 1, 0].astype(np.float64)  # layer 2, last denoise step, head 1
    roles = np.asarray(group["joint/key_role"])
    valid = ~np.isin(roles, [int(Role.MASKED_IMAGE), int(Role.PADDING), int(Role.NULL)])
    image = roles == int(Role.IMAGE)
    assert table["camera"].unique(maintain_order=True).to_list() == [CAMERA, "left_wrist_0_rgb"]
    for replan in (3, 1):
        own = table.filter((pl.col("camera") == CAMERA) & (pl.col("replan") == replan)).sort("row", "column")
        mass, of_images = rows[replan, :12], rows[replan, image[replan]].sum()
        np.testing.assert_allclose(own["mass"], mass, rtol=1e-6)
        np.testing.assert_allclose(own["share"], mass / of_images, rtol=1e-6)
        mean_key = rows[replan, valid[replan]].sum() / valid[replan].sum()
        np.testing.assert_allclose(own["lift"], mass / mean_key, rtol=1e-6)
        picture = shown.filter(camera=CAMERA, replan=replan).row(0, named=True)
        assert picture["share"] == pytest.approx(mass.sum() / of_images)
        assert picture["lift"] == pytest.approx(mass.max() / mean_key)


def test_words_have_their_lifts_and_outlines_their_patches(made: Path) -> None:
    result = overlay(question_about(made), episode=0, outline=(f"spot=patch:{CAMERA}[0:1,0:2]",))
    row = result.figures[0].frame.filter(camera=CAMERA, replan=0).row(0, named=True)
    assert row["words"] == ["put", "the", "bowl", "on", "the", "plate"]
    item = question_about(made).selected[0]
    rows = item.episode.read("joint/rows").astype(float).mean(axis=(1, 2, 3, 4))[0]
    mean_key = rows[item.tokens.valid[0]].mean()
    wanted = [rows[list(word.keys)].mean() / mean_key for word in item.tokens.words[item.tokens.prompt_index[0]]]
    np.testing.assert_allclose(row["lifts"], wanted, rtol=1e-5)
    assert np.argwhere(np.array(row["members"][0])).sum() in (1, 3, 5, 9)  # two neighbours, wherever they are turned
    assert np.array(row["members"][0]).sum() == 2


def test_an_instruction_that_changes_is_no_mean_of_two_and_leaves_films_of_one_size(made: Path) -> None:
    figure = overlay(question_about(made), episode=0).figures[0]
    told = [["on"], ["lift"], ["put", "the", "bowl", *["very"] * 20, "carefully"]]
    rows = [(told[min(replan, 2)], [1.0] * len(told[min(replan, 2)])) for replan in figure.frame["replan"]]
    words, lifts = (pl.Series(name, [row[i] for row in rows]) for i, name in enumerate(("words", "lifts")))
    changed = dataclasses.replace(figure, frame=figure.frame.with_columns(words, lifts))
    (axes,) = draw(changed, Style()).axes
    assert not {"on", "lift", "put"} & {text.get_text() for text in axes.texts}
    assert len({picture.shape for picture in _film(changed)}) == 1


def test_without_frames_the_map_alone_is_drawn_with_a_note(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    store = kit.write_store(tmp_path / "bare.zarr", tasks=(0,), episodes=1, frames=False)
    assert main(["overlay", str(store), "--output", str(tmp_path / "out"), "--video", "gif", "--smooth"]) == 0
    assert "pictures" in capsys.readouterr().out
    from PIL import Image

    with Image.open(tmp_path / "out/overlay_task000_episode000.gif") as gif:
        assert gif.n_frames == 3


def test_episodes_are_chosen_over_all_tasks_solved_and_failed_ones_in_turn(made: Path) -> None:
    selected = question_about(made).selected
    for count in range(1, 8):
        chosen = choose_episodes(selected, count)
        assert len({id(item) for item in chosen}) == min(count, len(selected))
        tasks = [item.task for item in chosen]
        assert max(map(tasks.count, tasks)) - min(map(tasks.count, tasks)) <= 1 or count == 1
    both = [item.episode.attributes.success for item in choose_episodes(selected, 2)]
    assert both == [True, False]


@pytest.mark.parametrize(
    ("extra", "named"),
    [
        (["--cameras", "base"], "'base_0_rgb'"),
        (["--replans", "9"], "replans 0 to 3"),
        (["--task", "7"], "task 7"),
        (["--outline", "x=word:kettle"], "'kettle'"),
        (["--outline", "x"], "NAME=SELECTOR"),
        (["--video", "gif", "--fps", "0"], "0.1 to 50"),
    ],
)
def test_bad_input_is_named_in_one_line(
    made: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], extra: list[str], named: str
) -> None:
    assert main(["overlay", str(made), "--output", str(tmp_path / "out"), *extra]) == 2
    captured = capsys.readouterr()
    assert named in captured.err
    assert "Traceback" not in captured.err
