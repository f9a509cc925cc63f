"""Data sets of version 3.0 that LeRobot itself wrote: read without it, and replayed with its SmolVLA."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import zarr

pytest.importorskip("lerobot", reason="run by make test-policies, in .venv-lerobot")

from lerobot.datasets.lerobot_dataset import LeRobotDataset

import vla_attention as va
from tests.kit.lerobot_data_sets import number_of, numbered_picture
from tests.policies import lerobot_models as models
from vla_attention.capture.__main__ import main as capture
from vla_attention.schemas.stores.reader import open_store
from vla_attention.schemas.stores.verify import verify_store

LENGTHS, TASKS = (7, 5, 9), ("put the bowl on the plate", "put the plate on the bowl")
CAMERAS = tuple(f"observation.images.{camera}" for camera in models.CAMERAS)
FILE = """
from pathlib import Path

import torch

import vla_attention as va
from tests.policies import lerobot_models as models
from tests.policies.word_tokenizer import WordTokenizer


def load(device):
    policy = models.small_smolvla(Path({folder!r}))

    def act(frame):
        ids = torch.tensor([WordTokenizer().encode(frame.instruction)])
        batch = {{
            name: (torch.from_numpy(picture.copy()).permute(2, 0, 1) / 255)[None]
            for name, picture in frame.images.items()
        }}
        batch["observation.state"] = torch.from_numpy(frame.values["observation.state"]).float()[None]
        batch["observation.language.tokens"] = ids
        batch["observation.language.attention_mask"] = torch.ones_like(ids, dtype=torch.bool)
        return policy.predict_action_chunk(batch)

    return va.datasets.ReplayPolicy(policy, va.layouts.smolvla(policy), act, tokenizer=WordTokenizer(), untrained=True)
"""


def written_by_lerobot(folder: Path, *, videos: bool, size: tuple[int, int] = (48, 64)) -> dict[str, list[np.ndarray]]:
    """Let LeRobot write a data set; returns the numbers of each episode by column."""
    camera = {"dtype": "video" if videos else "image", "shape": (*size, 3), "names": ["height", "width", "channels"]}
    numbers = {
        name: {"dtype": "float32", "shape": (count,), "names": [f"joint_{i}" for i in range(count)]}
        for name, count in (("observation.state", models.STATE_DIM), ("action", models.ACTION_DIM))
    }
    features = dict.fromkeys(CAMERAS, camera) | numbers
    data = LeRobotDataset.create(
        "me/test", fps=10, root=folder, robot_type="so101", features=features, use_videos=videos
    )
    generator = np.random.default_rng(0)
    kept: dict[str, list[np.ndarray]] = {name: [] for name in numbers}
    for episode, length in enumerate(LENGTHS):
        for name, feature in numbers.items():
            kept[name].append(generator.normal(size=(length, *feature["shape"])).astype(np.float32))
        for i in range(length):
            pictures = {name: numbered_picture(100 * episode + 50 * c + i, *size) for c, name in enumerate(CAMERAS)}
            values = {name: kept[name][episode][i] for name in numbers}
            data.add_frame({**pictures, **values, "task": TASKS[episode % 2]})
        data.save_episode()
    data.finalize()
    return kept


@pytest.mark.parametrize("videos", [True, False], ids=["av1", "png"])
def test_what_lerobot_wrote_is_read_exactly(tmp_path, videos):
    numbers = written_by_lerobot(tmp_path / "data", videos=videos, size=(64, 96))
    data = va.datasets.open(tmp_path / "data")
    assert (data.info.version, data.fps, data.cameras) == ("v3.0", 10.0, CAMERAS)
    assert [entry.length for entry in data.episodes] == list(LENGTHS)
    for index, length in enumerate(LENGTHS):
        episode = data.episode(index)
        for name, values in numbers.items():
            np.testing.assert_array_equal(episode.column(name), values[index])
        assert episode.instructions == (TASKS[index % 2],) * length
        for i, frame in enumerate(episode.frames()):
            assert [number_of(frame.images[name]) for name in CAMERAS] == [100 * index + i, 100 * index + 50 + i]


def test_smolvla_is_replayed_over_it(tmp_path, capsys):
    numbers = written_by_lerobot(tmp_path / "data", videos=True)
    (tmp_path / "vlm").mkdir()
    file, store = tmp_path / "my_smolvla.py", tmp_path / "replay.zarr"
    file.write_text(FILE.format(folder=str(tmp_path / "vlm")))
    arguments = ["replay", tmp_path / "data", "--policy", file, "--every", 4, "--episode", "1-2", "--output", store]
    assert capture([str(argument) for argument in arguments]) == 0
    assert "2 episodes added" in capsys.readouterr().out
    opened = open_store(store)
    assert verify_store(opened) == []
    assert [site.name for site in opened.attributes.sites] == ["self", "cross"]
    episode = zarr.open_group(store / "episodes" / "task000_episode002", mode="r")
    assert episode["actions"].shape == (3, 5, models.ACTION_DIM)
    np.testing.assert_array_equal(episode["state"][:], numbers["observation.state"][2][::4])
    np.testing.assert_array_equal(episode["dataset_actions"][0], numbers["action"][2][:5])
    assert episode.attrs["dataset_action_count"] == [5, 5, 1]
    assert episode.attrs["prompts"][0]["text"].split()[:6] == TASKS[0].split()
