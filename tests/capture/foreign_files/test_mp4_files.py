"""MP4 files as encoders write them, and lists that cannot be; `tests/thorough/hostile_data_sets` has more."""

from __future__ import annotations

import pytest

from tests.kit.lerobot_data_sets import H264, Encoding, numbered_picture, write_video
from tests.thorough.hostile_data_sets.mp4_boxes import box, samples_of_a_video
from vla_attention.capture.foreign_files.mp4_files import Mp4Refused, check_mp4


@pytest.mark.parametrize("encoding", [H264, Encoding()])
def test_videos_are_taken(tmp_path, encoding):
    path = tmp_path / "video.mp4"
    write_video(path, [numbered_picture(i) for i in range(20)], 10, encoding)
    assert check_mp4(path, 20) == path.stat().st_size
    with pytest.raises(Mp4Refused, match="20 pictures; expected at most 19"):
        check_mp4(path, 19)


def test_sizes_of_samples_are_compared_with_that_of_the_file(tmp_path):
    path = tmp_path / "video.mp4"
    path.write_bytes(samples_of_a_video([40, 3, 5]))
    check_mp4(path)
    path.write_bytes(
        samples_of_a_video([40, 3, 5]).replace(box("stsz", 0, 0, 3, 40, 3, 5), box("stsz", 0, 900, 3, 4, 3, 5))
    )
    with pytest.raises(Mp4Refused, match="pictures of 2,700 bytes"):
        check_mp4(path)
