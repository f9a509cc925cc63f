"""A run in the real simulator, its pictures as a data set, and the replay of that through the command lines."""

from __future__ import annotations

import numpy as np
import pytest
import zarr

from tests.kit.lerobot_data_sets import Encoding, episodes_of_store, write_data_set
from vla_attention.analyze.__main__ import main as analyze
from vla_attention.capture.__main__ import main as capture

COLUMNS = {"base_0_rgb": "image", "left_wrist_0_rgb": "wrist_image"}


@pytest.mark.simulator
def test_png_pictures_of_a_run_give_its_rows_to_the_bit_and_a_video_is_analysed(captured_store, tmp_path):
    episodes = episodes_of_store(captured_store, COLUMNS)[:2]  # the two of task 0: the noise depends on both numbers
    for name, encoding in (("png", None), ("video", Encoding())):
        data = write_data_set(tmp_path / name, "v3.0", episodes, video=encoding)
        options = ["--checkpoint", "untrained-tiny", "--every", "1", "--output", str(tmp_path / f"{name}.zarr")]
        assert capture(["replay", str(data), *options]) == 0
    for number in range(2):
        where = f"episodes/task000_episode{number:03d}"
        run, replay = (zarr.open_group(store / where, mode="r") for store in (captured_store, tmp_path / "png.zarr"))
        for array in ("joint/rows", "joint/key_role", "joint/contribution", "actions", "frames/base_0_rgb"):
            np.testing.assert_array_equal(run[array][:], replay[array][:], err_msg=array)
    video = str(tmp_path / "video.zarr")
    assert analyze(["words", video, "--output", str(tmp_path / "words"), "--no-plots"]) == 0
