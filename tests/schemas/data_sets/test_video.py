from __future__ import annotations

import numpy as np
import pytest

from tests.kit.lerobot_data_sets import H264, Encoding, number_of, numbered_picture, write_video
from vla_attention.schemas.data_sets.data_set_files import DamagedDataSet
from vla_attention.schemas.data_sets.video import UndecodableVideo, VideoFile

FPS, FRAMES = 10, 90
ENCODINGS = {
    "h264 with B-frames": Encoding("libx264", {"g": "40", "bf": "4", "x264-params": "b-adapt=0"}),
    "h264 with open groups": Encoding("libx264", {"g": "20", "bf": "3", "x264-params": "open-gop=1:b-adapt=0"}),
    "av1 as LeRobot": Encoding("libsvtav1", {"g": "2", "crf": "30", "preset": "12"}),
    "av1 with long groups": Encoding("libsvtav1", {"g": "64", "crf": "30", "preset": "12"}),
}


@pytest.mark.parametrize("name", ENCODINGS)
def test_the_picture_of_a_time_is_exact_to_the_frame_in_any_order(tmp_path, name):
    path = tmp_path / "video.mp4"
    write_video(path, [numbered_picture(i) for i in range(FRAMES)], FPS, ENCODINGS[name])
    generator = np.random.default_rng(0)
    orders = [range(FRAMES), range(0, FRAMES, 7), range(FRAMES - 1, -1, -11), generator.integers(0, FRAMES, 40)]
    video = VideoFile(path)
    np.testing.assert_allclose(video.times, np.arange(FRAMES) / FPS, atol=1e-9)
    for order in orders:
        shown = [number_of(video.picture(float(i) / FPS, 0.025)) for i in order]
        assert shown == [int(i) for i in order]
    # the last picture first: the decoder has to be emptied
    assert number_of(VideoFile(path).picture((FRAMES - 1) / FPS, 0.025)) == FRAMES - 1


def test_a_time_between_two_pictures_has_none(tmp_path):
    path = tmp_path / "video.mp4"
    write_video(path, [numbered_picture(i) for i in range(5)], FPS, H264)
    video = VideoFile(path)
    assert number_of(video.picture(0.22, 0.025)) == 2
    for seconds in (0.15, 0.23, -0.1, 0.5):
        with pytest.raises(DamagedDataSet, match=r"\d s"):
            video.picture(seconds, 0.025)


@pytest.mark.parametrize("text", ["ffconcat version 1.0\nfile 'other.mp4'\n", "#EXTM3U\n#EXTINF:1,\nother.mp4\n"])
def test_a_list_of_other_files_is_no_video(tmp_path, text):
    """FFmpeg would open the files and addresses that a playlist names."""
    write_video(tmp_path / "other.mp4", [numbered_picture(i) for i in range(5)], FPS, H264)
    path = tmp_path / "video.mp4"
    path.write_text(text)
    with pytest.raises(UndecodableVideo):
        VideoFile(path)


def test_a_codec_without_a_decoder_is_refused_by_name(tmp_path):
    path = tmp_path / "video.mp4"
    write_video(path, [numbered_picture(i) for i in range(5)], FPS, H264)
    content = path.read_bytes()
    assert content.count(b"avc1") == 2  # the brand of the file, and the name of its codec
    path.write_bytes(content[:40] + content[40:].replace(b"avc1", b"zzzz"))
    with pytest.raises(UndecodableVideo):
        VideoFile(path)


def test_a_damaged_video_is_an_error_and_never_a_wrong_picture(tmp_path):
    path = tmp_path / "video.mp4"
    generator = np.random.default_rng(1)
    pictures = [generator.integers(0, 255, (64, 96, 3)).astype(np.uint8) for _ in range(12)]
    write_video(path, pictures, FPS, H264)
    content = bytearray(path.read_bytes())
    content[len(content) // 3 : len(content) // 2] = bytes(len(content) // 2 - len(content) // 3)
    path.write_bytes(content)

    def read_all():
        video = VideoFile(path)
        for i in range(12):
            video.picture(i / FPS, 0.025)

    with pytest.raises(UndecodableVideo, match="damaged"):
        read_all()
