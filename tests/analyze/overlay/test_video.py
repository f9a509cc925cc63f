"""Videos read back: number, size and colours of pictures; bad input."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

from vla_attention.analyze.overlay.video import check_video, write_video
from vla_attention.schemas.errors import BadArgument, MissingDependency

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


@pytest.mark.parametrize("fps", [0, 51, float("nan")])
def test_bad_rates_are_refused(tmp_path: Path, fps: float) -> None:
    with pytest.raises(BadArgument, match=r"0\.1 to 50"):
        write_video(tmp_path / "a.gif", pictures(), fps, "gif")


def test_pictures_of_different_sizes_leave_no_file(tmp_path: Path) -> None:
    with pytest.raises(BadArgument, match="one size"):
        write_video(tmp_path / "a.gif", [*pictures(), np.zeros((3, 3, 3), np.uint8)], 4, "gif")
    with pytest.raises(BadArgument, match="at least one"):
        write_video(tmp_path / "a.gif", [], 4, "gif")
    assert list(tmp_path.iterdir()) == []


def test_mp4_without_the_extra_names_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    with pytest.raises(MissingDependency, match=r"vla-attention\[video\]"):
        check_video("mp4")
    check_video("gif")
