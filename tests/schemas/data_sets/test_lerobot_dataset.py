from __future__ import annotations

import json
from itertools import product
from pathlib import Path

import numpy as np
import polars as pl
import pytest

from tests.kit.lerobot_data_sets import (
    H264,
    Encoding,
    MadeUpEpisode,
    made_up_episodes,
    number_of,
    numbered_picture,
    write_data_set,
)
from tests.kit.thorough import thorough_except
from vla_attention.schemas.data_sets.data_set_files import DamagedDataSet, DataSetNotFound, UnsupportedDataSet
from vla_attention.schemas.data_sets.lerobot_dataset import open_dataset
from vla_attention.schemas.data_sets.video import UndecodableVideo
from vla_attention.schemas.errors import BadArgument, UnknownName

CAMERAS = ("observation.images.front", "observation.images.wrist")
ENCODINGS = {"png": None, "h264": H264, "av1": Encoding()}
VERSIONS = ("v2.1", "v3.0")


@pytest.mark.parametrize(
    ("encoding", "version"),
    thorough_except([("png", "v3.0"), ("h264", "v2.1")], product(ENCODINGS, VERSIONS), several=True),
)
def test_every_frame_has_its_own_picture_numbers_and_task(tmp_path, version, encoding):
    episodes = made_up_episodes((7, 5, 9), CAMERAS)
    data = open_dataset(write_data_set(tmp_path / "robot", version, episodes, video=ENCODINGS[encoding]))
    assert (data.name, data.fps, data.cameras) == ("robot", 10.0, CAMERAS)
    assert data.tasks == {0: "put the cup on the plate", 1: "open the drawer"}
    assert [(entry.index, entry.length) for entry in data.episodes] == [(0, 7), (1, 5), (2, 9)]
    for index, made in enumerate(episodes):
        episode = data.episode(index)
        np.testing.assert_array_equal(episode.column("action"), made.columns["action"])
        frames = list(episode.frames())
        assert [frame.index for frame in frames] == list(range(made.length))
        for i, frame in enumerate(frames):
            assert frame.seconds == pytest.approx(i / 10)
            assert frame.instruction == made.tasks[i]
            np.testing.assert_array_equal(frame.values["observation.state"], made.columns["observation.state"][i])
            for c, camera in enumerate(CAMERAS):
                assert number_of(frame.images[camera]) == 100 * index + 50 * c + i
                if encoding == "png":
                    np.testing.assert_array_equal(frame.images[camera], made.images[camera][i])


@pytest.mark.parametrize("version", VERSIONS)
def test_every_nth_frame_of_chosen_cameras(tmp_path, version):
    data = open_dataset(write_data_set(tmp_path / "robot", version, made_up_episodes((7, 40), CAMERAS), video=H264))
    frames = list(data.episode(1).frames(every=17, cameras=[CAMERAS[1]]))
    assert [frame.index for frame in frames] == [0, 17, 34]
    assert [number_of(frame.images[CAMERAS[1]]) for frame in frames] == [150, 167, 184]
    assert all(list(frame.images) == [CAMERAS[1]] for frame in frames)
    with pytest.raises(BadArgument, match="0th"):
        next(data.episode(1).frames(every=0))


def test_the_task_of_a_frame_may_change_within_an_episode(tmp_path):
    made = made_up_episodes((4,))[0]
    episode = MadeUpEpisode(made.images, made.columns, ["open it", "open it", "close it", "close it"])
    data = open_dataset(write_data_set(tmp_path / "robot", "v3.0", [episode]))
    assert data.episode(0).instructions == ("open it", "open it", "close it", "close it")


def test_the_digest_names_the_content_and_not_the_place(tmp_path):
    episodes = made_up_episodes((4, 3))
    one = open_dataset(write_data_set(tmp_path / "one", "v3.0", episodes))
    two = open_dataset(write_data_set(tmp_path / "two", "v3.0", episodes))
    other = open_dataset(write_data_set(tmp_path / "other", "v3.0", episodes[:1]))
    assert one.digest == two.digest != other.digest


def test_episodes_are_in_the_order_of_their_numbers_and_the_last_of_several_counts(tmp_path):
    folder = write_data_set(tmp_path / "robot", "v2.1", made_up_episodes((3, 4)))
    lines = (folder / "meta" / "episodes.jsonl").read_text().splitlines()
    wrong = json.dumps({**json.loads(lines[0]), "length": 9})
    (folder / "meta" / "episodes.jsonl").write_text("\n".join([wrong, lines[1], "", lines[0]]))
    data = open_dataset(folder)
    assert [(entry.index, entry.length) for entry in data.episodes] == [(0, 3), (1, 4)]
    assert data.episode_numbers == [0, 1]


def test_whole_numbers_of_tables_may_be_stored_as_floats(tmp_path):
    """pandas makes floats of a column of whole numbers when it joins tables."""
    folder = write_data_set(tmp_path / "robot", "v3.0", made_up_episodes((3, 4)), video=H264)
    (path,) = (folder / "meta" / "episodes").glob("*/*.parquet")
    rows = pl.read_parquet(path)
    numbers = [name for name in rows.columns if name.endswith("_index")]
    rows.with_columns(pl.col(name).cast(pl.Float64) for name in numbers).write_parquet(path)
    data = open_dataset(folder)
    assert [number_of(frame.images[CAMERAS[0]]) for frame in data.episode(1).frames()] == [100, 101, 102, 103]
    rows.with_columns(pl.lit(0.5).alias("data/file_index")).write_parquet(path)
    with pytest.raises(DamagedDataSet, match="'data/file_index'"):
        open_dataset(folder)


def test_rows_of_an_episode_follow_one_another(tmp_path):
    folder = write_data_set(tmp_path / "robot", "v3.0", made_up_episodes((3, 4)))
    (table,) = folder.glob("data/**/*.parquet")
    rows = pl.read_parquet(table)
    rows[[0, 3, 1, 2, 4, 5, 6]].write_parquet(table)
    with pytest.raises(DamagedDataSet, match=r"4 rows .* 0 to 2"):
        open_dataset(folder).episode(0)
    rows[[1, 0, 2, 3, 4, 5, 6]].write_parquet(table)
    with pytest.raises(DamagedDataSet, match=r"3 rows .* 0 to 2"):
        open_dataset(folder).episode(0)


def edit_info(folder, **changes):
    path = folder / "meta" / "info.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | changes))


def test_what_is_no_data_set_is_said(tmp_path):
    with pytest.raises(DataSetNotFound, match=r"nothing/at/all"):
        open_dataset(tmp_path / "nothing" / "at" / "all")


@pytest.mark.parametrize("version", ["v4.0"])
def test_another_version_is_refused_with_those_that_are_read(tmp_path, version):
    folder = write_data_set(tmp_path / "robot", "v2.1", made_up_episodes((3,)))
    edit_info(folder, codebase_version=version)
    with pytest.raises(UnsupportedDataSet, match=r"v2\.0, v2\.1, v3\.0"):
        open_dataset(folder)


@pytest.mark.parametrize("template", ["../../{episode_index}.parquet", "{elsewhere}"])
def test_a_path_template_stays_inside_of_the_data_set(tmp_path, template):
    folder = write_data_set(tmp_path / "robot", "v2.1", made_up_episodes((3,)))
    edit_info(folder, data_path=template)
    with pytest.raises(DamagedDataSet, match="path"):
        open_dataset(folder)


@pytest.mark.parametrize("version", VERSIONS)
def test_an_unknown_episode_and_missing_files_are_said(tmp_path, version):
    folder = write_data_set(tmp_path / "robot", version, made_up_episodes((3, 4, 3)), video=H264)
    data = open_dataset(folder)
    with pytest.raises(UnknownName, match=r"\b3; .* 0 to 2"):
        data.episode(3)
    videos = sorted(folder.glob("videos/**/*.mp4"))
    videos[-1].unlink()
    data.check_files([0], data.cameras)
    with pytest.raises(DataSetNotFound, match=r"\b1 of .*mp4"):
        data.check_files([0, 2], data.cameras)
    with pytest.raises(DataSetNotFound, match="video"):
        list(data.episode(2).frames())
    for table in folder.glob("data/**/*.parquet"):
        table.unlink()
    with pytest.raises(DataSetNotFound, match="parquet"):
        data.episode(0)


def test_rows_that_contradict_the_meta_files_are_refused(tmp_path):
    folder = write_data_set(tmp_path / "robot", "v2.1", made_up_episodes((4,)))
    table = next(folder.glob("data/**/*.parquet"))
    rows = pl.read_parquet(table)
    rows.head(3).write_parquet(table)
    with pytest.raises(DamagedDataSet, match=r"3 rows .* 0 to 3"):
        open_dataset(folder).episode(0)
    rows.with_columns(pl.lit(7).alias("task_index")).write_parquet(table)
    with pytest.raises(DamagedDataSet, match="task 7"):
        open_dataset(folder).episode(0)
    table.write_bytes(b"no table")
    with pytest.raises(DamagedDataSet, match=r"\.parquet"):
        open_dataset(folder).episode(0)


@pytest.mark.parametrize("fps", [30, 11, 9, 0.001, 1e300])
def test_a_frame_rate_that_contradicts_the_time_stamps_is_refused(tmp_path, fps):
    info = write_data_set(tmp_path / "robot", "v2.1", made_up_episodes((4, 3)), fps=10) / "meta" / "info.json"
    info.write_text(json.dumps(json.loads(info.read_text()) | {"fps": fps}))
    with pytest.raises(DamagedDataSet, match=r"0\.1 s .*\(10 frames per second\), .* fps"):
        open_dataset(tmp_path / "robot").episode(1)


def test_time_stamps_of_a_clock_that_jitters_are_taken(tmp_path):
    folder = write_data_set(tmp_path / "robot", "v2.1", made_up_episodes((40,)), fps=10)
    table = next(folder.glob("data/**/*.parquet"))
    jitter = np.random.default_rng(0).uniform(-0.01, 0.01, 40).astype(np.float32)
    rows = pl.read_parquet(table)
    rows.with_columns(pl.col("timestamp") + pl.Series(jitter)).write_parquet(table)
    assert open_dataset(folder).episode(0).length == 40


def test_numbers_that_are_not_finite_are_refused(tmp_path):
    episode = made_up_episodes((4,))[0]
    episode.columns["action"][2, 1] = np.nan
    data = open_dataset(write_data_set(tmp_path / "robot", "v3.0", [episode]))
    with pytest.raises(DamagedDataSet, match=r"'action' of episode 0 .* frame 2"):
        data.episode(0).column("action")
    with pytest.raises(UnknownName, match="'action'"):
        data.episode(0).column("actions")


@pytest.mark.parametrize(("index", "length"), [(0, 0), (0, 10**12)])
def test_numbers_of_episodes_that_cannot_be_are_refused(tmp_path, index, length):
    folder = write_data_set(tmp_path / "robot", "v2.1", made_up_episodes((3,)))
    line = {"episode_index": index, "length": length, "tasks": []}
    (folder / "meta" / "episodes.jsonl").write_text(json.dumps(line))
    with pytest.raises(DamagedDataSet, match=r"one frame|3 rows"):
        open_dataset(folder).episode(0)


def test_a_video_that_is_shorter_than_its_table_is_refused(tmp_path):
    from tests.kit.lerobot_data_sets import write_video

    folder = write_data_set(tmp_path / "robot", "v2.1", made_up_episodes((6,)), video=H264)
    write_video(next(folder.glob("videos/**/*.mp4")), [numbered_picture(i) for i in range(5)], 10, H264)
    with pytest.raises(DamagedDataSet, match=r"0\.5000 s: .* 5 .* 0\.0000 to 0\.4000 s"):
        list(open_dataset(folder).episode(0).frames())


def with_times(folder: Path, episode: int, **columns: pl.Expr) -> None:
    """Change columns of times of one episode in the table of a data set of version 3.0."""
    (path,) = (folder / "meta" / "episodes").rglob("*.parquet")
    is_it = pl.col("episode_index") == episode
    named = {f"videos/observation.images.front/{name}_timestamp": value for name, value in columns.items()}
    changed = [pl.when(is_it).then(value).otherwise(pl.col(name)).alias(name) for name, value in named.items()]
    pl.read_parquet(path).with_columns(changed).write_parquet(path)


@pytest.mark.parametrize("shift", [-0.7, -0.1, 0.3])
def test_an_episode_whose_pictures_are_said_to_be_anothers_is_refused(tmp_path, shift):
    """Of three in one file, the second; a gap of half a frame is none, one to the third is an overlap."""
    folder = write_data_set(tmp_path / "a", "v3.0", made_up_episodes((7, 5, 9)), video=H264, episodes_per_file=3)
    begins, ends = (pl.col(f"videos/observation.images.front/{name}_timestamp") for name in ("from", "to"))
    with_times(folder, 1, **{"from": begins + 0.04, "to": ends + 0.04})
    assert len(open_dataset(folder).episodes) == 3
    with_times(folder, 1, **{"from": begins + shift, "to": ends + shift})
    with pytest.raises(DamagedDataSet, match=r"episode [12]"):
        open_dataset(folder)
    with_times(folder, 1, **{"from": begins - shift - 0.04, "to": ends - shift + 0.3})
    with pytest.raises(DamagedDataSet, match="episode 1"):
        open_dataset(folder)


def test_deleted_episodes_leave_gaps_in_a_video(tmp_path):
    folder = write_data_set(tmp_path / "a", "v3.0", made_up_episodes((7, 5, 9)), video=H264, episodes_per_file=3)
    (path,) = (folder / "meta" / "episodes").rglob("*.parquet")
    pl.read_parquet(path).filter(pl.col("episode_index") != 1).write_parquet(path)
    data = open_dataset(folder)
    assert data.episode_numbers == [0, 2]
    shown = [number_of(frame.images["observation.images.front"]) for frame in data.episode(2).frames()]
    assert shown == [200 + frame for frame in range(9)]


def test_a_video_that_ends_before_frames_that_are_not_read_is_refused(tmp_path):
    folder = write_data_set(tmp_path / "a", "v3.0", made_up_episodes((7, 5)), video=H264)
    with_times(folder, 1, **{f: pl.col(f"videos/observation.images.front/{f}_timestamp") + 0.2 for f in ("from", "to")})
    with pytest.raises(DamagedDataSet, match=r"1\.3000 s"):
        next(open_dataset(folder).episode(1).frames(every=3))


def test_tasks_may_be_in_the_rows_alone(tmp_path):
    folder = write_data_set(tmp_path / "a", "v3.0", made_up_episodes())
    (path,) = (folder / "meta" / "episodes").rglob("*.parquet")
    pl.read_parquet(path).drop("tasks").write_parquet(path)
    data = open_dataset(folder)
    assert [entry.tasks for entry in data.episodes] == [(), (), ()]
    tasks = ["put the cup on the plate", "open the drawer", "put the cup on the plate"]
    assert [set(data.episode(number).instructions) for number in range(3)] == [{task} for task in tasks]


def test_a_damaged_video_and_a_damaged_picture_are_refused(tmp_path):
    folder = write_data_set(tmp_path / "video", "v2.1", made_up_episodes((6,)), video=H264)
    video = next(folder.glob("videos/**/*.mp4"))
    video.write_bytes(b"no video at all")
    with pytest.raises(UndecodableVideo, match=r"\.mp4"):
        list(open_dataset(folder).episode(0).frames())
    folder = write_data_set(tmp_path / "png", "v2.1", made_up_episodes((2,)))
    table = next(folder.glob("data/**/*.parquet"))
    cell = {"bytes": b"no picture", "path": None}
    kind = pl.Struct({"bytes": pl.Binary, "path": pl.String})
    pl.read_parquet(table).with_columns(pl.Series(CAMERAS[0], [cell, cell], dtype=kind)).write_parquet(table)
    with pytest.raises(DamagedDataSet, match=f"'{CAMERAS[0]}' in episode 0 of 'png'"):
        list(open_dataset(folder).episode(0).frames())


def test_pictures_may_be_files_of_the_data_set_and_no_others(tmp_path):
    made = made_up_episodes((2,))
    folder = write_data_set(tmp_path / "robot", "v2.1", made)
    table = next(folder.glob("data/**/*.parquet"))
    kind = pl.Struct({"bytes": pl.Binary, "path": pl.String})
    rows = pl.read_parquet(table)
    (folder / "images").mkdir()
    for i, cell in enumerate(rows[CAMERAS[0]]):
        (folder / "images" / f"{i}.png").write_bytes(cell["bytes"])
    (tmp_path / "outside.png").write_bytes(rows[CAMERAS[0]][0]["bytes"])
    cells = [{"bytes": None, "path": f"images/{i}.png"} for i in range(2)]
    rows.with_columns(pl.Series(CAMERAS[0], cells, dtype=kind)).write_parquet(table)
    frames = list(open_dataset(folder).episode(0).frames())
    assert [number_of(frame.images[CAMERAS[0]]) for frame in frames] == [0, 1]
    for place in ("../outside.png", str(tmp_path / "outside.png"), ""):
        cells = [{"bytes": None, "path": place}] * 2
        rows.with_columns(pl.Series(CAMERAS[0], cells, dtype=kind)).write_parquet(table)
        with pytest.raises(DataSetNotFound):
            list(open_dataset(folder).episode(0).frames())


def test_names_of_the_hub(tmp_path, monkeypatch):
    monkeypatch.setenv("HF_LEROBOT_HOME", str(tmp_path))
    write_data_set(tmp_path / "lerobot" / "pusht", "v3.0", made_up_episodes((3,)))
    assert open_dataset("lerobot/pusht").name == "lerobot/pusht"
