"""Videos read back: number, size and colours of pictures; bad input."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from vla_attention.analyze.render.video import write_video

COLORS = ((200, 30, 40), (20, 160, 60), (30, 40, 220))


def pictures(height: int = 33, width: int = 47) -> list[np.ndarray]:
    return [np.full((height, width, 3), color, dtype=np.uint8) for color in COLORS]


def test_a_gif_has_every_picture_at_its_rate(tmp_path: Path) -> None:
    from PIL import Image

    path = write_video(tmp_path / "a.gif", iter(pictures()), 4, "gif")
    with Image.open(path) as gif:
        assert (gif.n_frames, gif.size) == (3, (47, 33))
        for i, color in enumerate(COLORS):
            gif.seek(i)
            assert gif.info["duration"] == 250
            np.testing.assert_allclose(np.asarray(gif.convert("RGB"))[10, 10], color, atol=4)


def test_a_small_cube_keeps_its_colour_in_a_gif_of_large_grey_pictures(tmp_path: Path) -> None:
    from PIL import Image

    generator = np.random.default_rng(0)
    frames = [np.repeat(generator.integers(0, 255, (120, 160, 1), dtype=np.uint8), 3, axis=2) for _ in range(9)]
    frames[4][50:54, 60:64] = (40, 170, 60)  # neither in the first, the middle nor the last quarter alone
    frames[6][50:54, 60:64] = (190, 40, 30)
    with Image.open(write_video(tmp_path / "a.gif", frames, 4, "gif")) as gif:
        for i in (4, 6):
            gif.seek(i)
            np.testing.assert_allclose(np.asarray(gif.convert("RGB"))[52, 62], frames[i][52, 62], atol=8)


def test_an_mp4_has_even_sides_and_every_picture(tmp_path: Path) -> None:
    imageio_ffmpeg = pytest.importorskip("imageio_ffmpeg", reason="needs the extra [video]")
    path = write_video(tmp_path / "a.mp4", pictures(), 5, "mp4")
    reader = imageio_ffmpeg.read_frames(str(path))
    meta = next(reader)
    assert (meta["size"], meta["fps"]) == ((48, 34), 5)
    frames = [np.frombuffer(frame, dtype=np.uint8).reshape(34, 48, 3) for frame in reader]
    assert len(frames) == 3
    for frame, color in zip(frames, COLORS, strict=True):
        np.testing.assert_allclose(frame[10, 10], color, atol=12)


def noise() -> list[np.ndarray]:
    generator = np.random.default_rng(0)
    return [generator.integers(0, 255, (64, 64, 3), dtype=np.uint8) for _ in range(8)]


def test_a_disk_that_takes_no_more_is_an_error_and_leaves_no_part_of_an_mp4(tmp_path: Path) -> None:
    """ffmpeg is another process: its error has to be asked for."""
    pytest.importorskip("imageio_ffmpeg", reason="needs the extra [video]")
    assert write_video(tmp_path / "whole.mp4", noise(), 5, "mp4").stat().st_size > 20_000
    code = (
        "import resource, sys; from pathlib import Path; from vla_attention.schemas.errors import BadArgument\n"
        "from tests.analyze.render.test_video import noise, write_video\n"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, 20_000))\n"
        "try:\n    write_video(Path(sys.argv[1]), noise(), 5, 'mp4')\n"
        "except BadArgument as error:\n    print(error)\n"
    )
    command = [sys.executable, "-c", code, str(tmp_path / "a.mp4")]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert str(tmp_path / "a.mp4") in done.stdout
    assert [path.name for path in tmp_path.iterdir()] == ["whole.mp4"]
