"""Pictures of a video file by their times, exact to the frame.

A video stores most pictures as changes to others, some of them to later ones (B-frames), and a decoder can only begin
at a key frame. Which pictures there are is read from the packets, without decoding; then pictures are decoded until the
one with exactly the wanted time stamp. Where a seek ends does not matter.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vla_attention.schemas.data_sets.data_set_files import DamagedDataSet, DataSetError, DataSetNotFound
from vla_attention.schemas.errors import MissingDependency
from vla_attention.schemas.install_line import install_line

#: How many pictures before the wanted one decoding begins, one after the other until the picture comes out whole: a
#: seek may end behind it, and in an open group pictures need the group before.
_EARLIER = (0, 16, 256, 4096)
#: Up to so many pictures ahead, decoding on is faster than a seek.
_AHEAD = 16
#: How FFmpeg opens a file: only as MP4. Of a list of files or addresses (concat, HLS), it would open each.
_OPTIONS = {"format_whitelist": "mov,mp4,m4a,3gp,3g2,mj2", "protocol_whitelist": "file"}


class UndecodableVideo(DataSetError):
    """A video whose pictures cannot be decoded."""


def import_av() -> Any:
    """Return the module of PyAV; `MissingDependency` without it."""
    try:
        import av
        import av.error
    except ImportError as error:
        raise MissingDependency(
            f"Videos are decoded with PyAV, which is not installed; install it with `{install_line('datasets')}`."
        ) from error
    return av


def decoder_version() -> dict[str, str]:
    """Return the version of what decodes videos, for provenance: another one may give other pictures."""
    try:
        return {"av": metadata.version("av")}
    except metadata.PackageNotFoundError:
        return {"av": "absent"}


class VideoFile:
    """An MP4 file, opened for reading pictures.

    times: (frame,) float64, the time of every picture in seconds, in the order in which they are shown.

    Raises:
        DataSetNotFound: there is no such file.
        UndecodableVideo: the file is no video, is damaged, or the installed PyAV has no decoder for its codec.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._av = import_av()
        if not path.is_file():
            raise DataSetNotFound(f"There is no video '{path}', which the data set names.")
        with self._refusing("is no video that can be read"):
            # With the name of the protocol: the first part of a name with a colon would be one.
            self._container = self._av.open(f"file:{path}", options=_OPTIONS)
        streams = self._container.streams.video
        if streams and streams[0].codec_context is None:
            raise UndecodableVideo(
                f"'{path}' cannot be decoded: the installed PyAV ({self._av.__version__}) has no decoder for its "
                "codec; convert the video to H.264 or AV1."
            )
        with self._refusing("is damaged"):
            packets = self._container.demux(streams[0]) if streams else ()
            self._stamps = np.array(
                sorted(packet.pts for packet in packets if packet.pts is not None and not packet.is_discard), np.int64
            )
        if not len(self._stamps):
            raise UndecodableVideo(f"'{path}' holds no pictures.")
        self._stream = streams[0]
        self._size = (self._stream.codec_context.height, self._stream.codec_context.width)
        self.times: NDArray[np.float64] = self._stamps.astype(np.float64) * float(self._stream.time_base)
        self._decoded: Iterator[Any] = iter(())
        self._current: Any = None

    def picture(self, seconds: float, tolerance: float) -> NDArray[np.uint8]:
        """Return the picture (height, width, 3) RGB that is shown at a time.

        Pictures in the order of their times are decoded once each; any other order is right too, and slower.

        Args:
            seconds: the time.
            tolerance: how far the time of the picture may be from it, in seconds.

        Raises:
            DamagedDataSet: no picture has this time.
            UndecodableVideo: the file is damaged.
        """
        nearest = self.nearest(seconds, tolerance)
        with self._refusing("is damaged"):
            is_near = self._current is not None and 0 <= nearest - self._place(self._current) <= _AHEAD
            for earlier in (None, *_EARLIER) if is_near else _EARLIER:
                if earlier is not None:
                    begin = int(self._stamps[max(nearest - earlier, 0)])
                    self._container.seek(begin, stream=self._stream, backward=True, any_frame=False)
                    self._decoded, self._current = self._container.decode(self._stream), None
                frame = self._decoded_until(int(self._stamps[nearest]))
                if frame is not None and not frame.is_corrupt and (frame.height, frame.width) == self._size:
                    return np.ascontiguousarray(frame.to_ndarray(format="rgb24"))
        raise UndecodableVideo(f"'{self.path}' is damaged: the picture at {seconds:.4f} s cannot be decoded whole.")

    def nearest(self, seconds: float, tolerance: float) -> int:
        """Return the place of the picture at a time; `DamagedDataSet` where none is."""
        nearest = int(np.abs(self.times - seconds).argmin())
        if not abs(self.times[nearest] - seconds) <= tolerance:
            raise DamagedDataSet(
                f"'{self.path}' has no picture at {seconds:.4f} s: its {len(self.times)} pictures are at "
                f"{self.times[0]:.4f} to {self.times[-1]:.4f} s, the nearest at {self.times[nearest]:.4f} s."
            )
        return nearest

    def _place(self, frame: Any) -> int:
        return int(np.searchsorted(self._stamps, frame.pts))

    def _decoded_until(self, stamp: int) -> Any:
        """Decode on until the frame with this time stamp; None if it does not come."""
        while self._current is None or self._current.pts < stamp:
            self._current = next((frame for frame in self._decoded if frame.pts is not None), None)
            if self._current is None:  # the end of the file
                return None
        return self._current if self._current.pts == stamp else None

    @contextmanager
    def _refusing(self, what: str) -> Iterator[None]:
        try:
            yield
        except (self._av.error.FFmpegError, ValueError, OSError) as error:
            reason = (getattr(error, "strerror", None) or str(error) or type(error).__name__).strip()
            raise UndecodableVideo(f"'{self.path}' {what} ({reason.splitlines()[0].rstrip('.')}).") from error
