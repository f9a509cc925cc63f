"""Small LeRobotDatasets with the real file layout, versions 2.1 and 3.0, and pictures that show their own number."""

from __future__ import annotations

import io
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import polars as pl
from PIL import Image

#: What LeRobot writes into info.json.
TEMPLATES = {
    "v2.1": {
        "data_path": "data/chunk-{episode_chunk:03d}/episode_{episode_index:06d}.parquet",
        "video_path": "videos/chunk-{episode_chunk:03d}/{video_key}/episode_{episode_index:06d}.mp4",
    },
    "v3.0": {
        "data_path": "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
        "video_path": "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4",
    },
}
_BITS = 10


def numbered_picture(number: int, height: int = 64, width: int = 96) -> np.ndarray:
    """A picture (height, width, 3) of ten stripes, dark or bright as the bits of a number; `number_of` reads it."""
    picture = np.full((height, width, 3), 20, dtype=np.uint8)
    edges = np.linspace(0, width, _BITS + 1).astype(int)
    for bit in range(_BITS):
        if number >> bit & 1:
            picture[:, edges[bit] : edges[bit + 1]] = 235
    return picture


def number_of(picture: np.ndarray) -> int:
    """The number that a picture shows, also after a lossy encoding."""
    edges = np.linspace(0, picture.shape[1], _BITS + 1).astype(int)
    stripes = [picture[:, edges[bit] + 2 : edges[bit + 1] - 2].mean() for bit in range(_BITS)]
    return sum(int(stripe > 128) << bit for bit, stripe in enumerate(stripes))


@dataclass(frozen=True)
class MadeUpEpisode:
    """One episode: pictures (frame, height, width, 3) by camera, numbers (frame, number) by column, task per frame."""

    images: Mapping[str, np.ndarray]
    columns: Mapping[str, np.ndarray]
    tasks: Sequence[str]

    @property
    def length(self) -> int:
        return len(self.tasks)


def made_up_episodes(
    lengths: Sequence[int] = (7, 5, 9),
    cameras: Sequence[str] = ("observation.images.front",),
    state: int = 6,
    action: int = 6,
    tasks: Sequence[str] = ("put the cup on the plate", "open the drawer"),
    size: tuple[int, int] = (64, 96),
) -> list[MadeUpEpisode]:
    """Episodes whose pictures show 100 · episode + frame (plus 50 in every second camera), and random numbers."""
    generator = np.random.default_rng(3)
    episodes = []
    for index, length in enumerate(lengths):
        images = {
            camera: np.stack([numbered_picture(100 * index + 50 * (c % 2) + i, *size) for i in range(length)])
            for c, camera in enumerate(cameras)
        }
        columns = {
            "observation.state": generator.normal(size=(length, state)).astype(np.float32),
            "action": generator.normal(size=(length, action)).astype(np.float32),
        }
        episodes.append(MadeUpEpisode(images, columns, [tasks[index % len(tasks)]] * length))
    return episodes


@dataclass(frozen=True)
class Encoding:
    """How videos are encoded. The defaults are those of LeRobot's AV1 files, with a long way between key frames."""

    codec: str = "libsvtav1"
    options: Mapping[str, str] = field(default_factory=lambda: {"g": "30", "crf": "30", "preset": "12"})
    pixels: str = "yuv420p"


H264 = Encoding("libx264", {"g": "50", "bf": "3", "crf": "18"})


def write_video(path: Path, pictures: Sequence[np.ndarray], fps: int, encoding: Encoding) -> None:
    import av

    path.parent.mkdir(parents=True, exist_ok=True)
    with av.open(str(path), "w") as output:
        stream = output.add_stream(encoding.codec, rate=fps, options=dict(encoding.options))
        stream.height, stream.width = pictures[0].shape[:2]
        stream.pix_fmt = encoding.pixels
        for picture in pictures:
            for packet in stream.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")):
                output.mux(packet)
        for packet in stream.encode():
            output.mux(packet)


def write_data_set(
    folder: Path,
    version: str,
    episodes: Sequence[MadeUpEpisode],
    *,
    fps: int = 10,
    video: Encoding | None = None,
    episodes_per_file: int = 2,
    robot_type: str = "so101",
) -> Path:
    """Write a data set; videos if there is an encoding, else PNG pictures in the tables. Returns the folder."""
    tasks = list(dict.fromkeys(task for episode in episodes for task in episode.tasks))
    features = _features(episodes[0], "video" if video else "image", fps)
    info = {
        "codebase_version": version,
        "robot_type": robot_type,
        "total_episodes": len(episodes),
        "total_frames": sum(episode.length for episode in episodes),
        "total_tasks": len(tasks),
        "chunks_size": 1000,
        "fps": fps,
        "splits": {"train": f"0:{len(episodes)}"},
        **TEMPLATES[version],
        "features": features,
    }
    if not video:
        info["video_path"] = None
    (folder / "meta").mkdir(parents=True)
    (folder / "meta" / "info.json").write_text(json.dumps(info, indent=4))
    first = np.cumsum([0, *(episode.length for episode in episodes)])
    tables = [
        _table(episode, index, int(first[index]), fps, tasks, with_pictures=not video)
        for index, episode in enumerate(episodes)
    ]
    if version == "v2.1":
        _write_v21(folder, episodes, tables, tasks, fps, video)
    else:
        _write_v30(folder, episodes, tables, tasks, fps, video, episodes_per_file)
    return folder


def _features(episode: MadeUpEpisode, kind: str, fps: int) -> dict[str, object]:
    features: dict[str, object] = {}
    for name, values in episode.columns.items():
        names = {"motors": [f"motor_{i}" for i in range(values.shape[1])]}
        features[name] = {"dtype": str(values.dtype), "shape": [values.shape[1]], "names": names}
    for camera, pictures in episode.images.items():
        features[camera] = {
            "dtype": kind,
            "shape": list(pictures.shape[1:]),
            "names": ["height", "width", "channels"],
            **({"info": {"video.fps": fps, "video.is_depth_map": False}} if kind == "video" else {}),
        }
    features["timestamp"] = {"dtype": "float32", "shape": [1], "names": None}
    for name in ("frame_index", "episode_index", "index", "task_index"):
        features[name] = {"dtype": "int64", "shape": [1], "names": None}
    return features


def _table(
    episode: MadeUpEpisode, index: int, first: int, fps: int, tasks: Sequence[str], *, with_pictures: bool
) -> pl.DataFrame:
    columns: list[pl.Series] = []
    for name, values in episode.columns.items():
        if values.shape[1] == 1:
            columns.append(pl.Series(name, values[:, 0]))
        else:
            columns.append(pl.Series(name, values, dtype=pl.Array(_DTYPES[str(values.dtype)], values.shape[1])))
    if with_pictures:
        for camera, pictures in episode.images.items():
            cells = [
                {"bytes": png(picture), "path": f"frame-{i:06d}.png"} for i, picture in enumerate(pictures)
            ]  # as the package `datasets` writes pictures
            columns.append(pl.Series(camera, cells, dtype=pl.Struct({"bytes": pl.Binary, "path": pl.String})))
    frames = np.arange(episode.length)
    columns += [
        pl.Series("timestamp", (frames / fps).astype(np.float32)),
        pl.Series("frame_index", frames, dtype=pl.Int64),
        pl.Series("episode_index", np.full(episode.length, index), dtype=pl.Int64),
        pl.Series("index", first + frames, dtype=pl.Int64),
        pl.Series("task_index", [tasks.index(task) for task in episode.tasks], dtype=pl.Int64),
    ]
    return pl.DataFrame(columns)


_DTYPES = {"float32": pl.Float32, "float64": pl.Float64, "int64": pl.Int64, "bool": pl.Boolean}


def png(picture: np.ndarray) -> bytes:
    return encoded("PNG", picture)


def encoded(kind: str, picture: np.ndarray, **options: object) -> bytes:
    """A picture (height, width, 3) in one of pillow's formats."""
    buffer = io.BytesIO()
    Image.fromarray(picture).save(buffer, format=kind, **options)
    return buffer.getvalue()


def _write_v21(folder, episodes, tables, tasks, fps, video):
    lines = [{"task_index": index, "task": task} for index, task in enumerate(tasks)]
    _write_lines(folder / "meta" / "tasks.jsonl", lines)
    entries = [
        {"episode_index": index, "tasks": list(dict.fromkeys(episode.tasks)), "length": episode.length}
        for index, episode in enumerate(episodes)
    ]
    _write_lines(folder / "meta" / "episodes.jsonl", entries)
    for index, (episode, table) in enumerate(zip(episodes, tables, strict=True)):
        path = folder / TEMPLATES["v2.1"]["data_path"].format(episode_chunk=0, episode_index=index)
        path.parent.mkdir(parents=True, exist_ok=True)
        table.write_parquet(path)
        for camera, pictures in episode.images.items() if video else ():
            template = TEMPLATES["v2.1"]["video_path"]
            place = template.format(episode_chunk=0, episode_index=index, video_key=camera)
            write_video(folder / place, list(pictures), fps, video)


def _write_v30(folder, episodes, tables, tasks, fps, video, per_file):
    # pandas writes the table of tasks with the tasks as its index.
    pl.DataFrame({"task_index": range(len(tasks)), "__index_level_0__": tasks}).write_parquet(
        folder / "meta" / "tasks.parquet"
    )
    rows = []
    starts = np.cumsum([0, *(episode.length for episode in episodes)])
    for first in range(0, len(episodes), per_file):
        file, members = first // per_file, range(first, min(first + per_file, len(episodes)))
        path = folder / TEMPLATES["v3.0"]["data_path"].format(chunk_index=0, file_index=file)
        path.parent.mkdir(parents=True, exist_ok=True)
        pl.concat([tables[index] for index in members]).write_parquet(path)
        for camera in episodes[first].images if video else ():
            template = TEMPLATES["v3.0"]["video_path"]
            place = template.format(chunk_index=0, file_index=file, video_key=camera)
            pictures = [picture for index in members for picture in episodes[index].images[camera]]
            write_video(folder / place, pictures, fps, video)
        for index in members:
            row = {
                "episode_index": index,
                "tasks": list(dict.fromkeys(episodes[index].tasks)),
                "length": episodes[index].length,
                "data/chunk_index": 0,
                "data/file_index": file,
                "dataset_from_index": int(starts[index]),
                "dataset_to_index": int(starts[index + 1]),
                "stats/action/mean": episodes[index].columns["action"].mean(axis=0).tolist(),
                "meta/episodes/chunk_index": 0,
                "meta/episodes/file_index": 0,
            }
            for camera in episodes[index].images if video else ():
                begins_at = float(starts[index] - starts[first]) / fps
                row |= {
                    f"videos/{camera}/chunk_index": 0,
                    f"videos/{camera}/file_index": file,
                    f"videos/{camera}/from_timestamp": begins_at,
                    f"videos/{camera}/to_timestamp": begins_at + episodes[index].length / fps,
                }
            rows.append(row)
    path = folder / "meta" / "episodes" / "chunk-000" / "file-000.parquet"
    path.parent.mkdir(parents=True)
    pl.DataFrame(rows).write_parquet(path)


def _write_lines(path: Path, lines: Sequence[object]) -> None:
    path.write_text("".join(f"{json.dumps(line)}\n" for line in lines))


def episodes_of_store(
    store: Path, columns: Mapping[str, str], *, own_pictures: bool = False, every: int = 1, state_dtype: str = "float64"
) -> list[MadeUpEpisode]:
    """The replans of a store of a simulator as episodes of a data set, in the orientation of LIBERO's data sets.

    columns: policy camera -> column. own_pictures: the cameras' own pictures, turned as the policy turns them. every:
    between two replans stand as many other frames, with numbers for pictures, as a replay with `--every` leaves out.
    """
    import zarr

    group = "camera_frames" if own_pictures else "frames"
    episodes = []
    for name in sorted(entry.name for entry in (store / "episodes").iterdir()):
        if not name.startswith("task"):
            continue
        stored = zarr.open_group(store / "episodes" / name, mode="r")
        replans = stored.attrs["num_replans"]
        length = (replans - 1) * every + 1
        images = {}
        for camera, column in columns.items():
            pictures = np.asarray(stored[f"{group}/{camera}"])
            pictures = pictures[:, ::-1, ::-1] if own_pictures else pictures
            filler = numbered_picture(1, *pictures.shape[1:3])
            images[column] = np.stack([pictures[i // every] if i % every == 0 else filler for i in range(length)])
        state, actions = np.asarray(stored["state"]), np.asarray(stored["actions"])[:, 0]
        repeat = np.arange(length) // every
        values = {"observation.state": state[repeat].astype(state_dtype), "action": actions[repeat].astype(np.float32)}
        episodes.append(MadeUpEpisode(images, values, [str(stored.attrs["instruction"])] * length))
    return episodes
