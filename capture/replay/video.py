"""Pictures of a video file by their times, exact to the frame.

A video stores most pictures as changes to others, some of them to later ones (B-frames), and a decoder can only begin
at a key frame. Which picture has which time is read from the packets, without decoding; then pictures are decoded from
the last key frame before the wanted one until the one with exactly its time stamp. Where a seek ends does not matter.
"""

from __future__ import annotations

from array import array
from collections.abc import Iterator
from importlib import metadata
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vla_attention.capture.replay.data_set_files import UndecodableVideo
from vla_attention.capture.replay.data_tables import DamagedDataSet, DataSetNotFound
from vla_attention.schemas.errors import MissingDependency

#: Key frames before the last one at which decoding begins again, where a picture does not come out: in an open group,
#: pictures need the one before.
_EARLIER_KEYS = 8
#: How FFmpeg opens a file: only as MP4. Of a list of files or addresses (concat, HLS), it would open each.
_OPTIONS = {"format_whitelist": "mov,mp4,m4a,3gp,3g2,mj2", "protocol_whitelist": "file"}


def import_av() -> Any:
    """Return the module of PyAV; `MissingDependency` without it."""
    try:
        import av
        import av.error
    except ImportError as error:
        raise MissingDependency(
            "Videos are decoded with PyAV, which is not installed; install it with "
            "`pip install 'vla-attention[datasets]'`."
        ) from error
    return av


def decoder_version() -> dict[str, str]:
    """Return the version of what decodes videos, for provenance: another one may give other pictures."""
    try:
        return {"av": metadata.version("av")}
    except metadata.PackageNotFoundError:
        return {"av": "absent"}


class VideoFile:
    """One video, opened for reading pictures; use it as a context, or `close` it.

    codec: its name, as FFmpeg calls it. size: (height, width) in pixels. times: (frame,) float64, the time of every
    picture in seconds, in the order in which they are shown.

    Args:
        path: of an MP4 file.

    Raises:
        DataSetNotFound: there is no such file.
        UndecodableVideo: the file is no video, is damaged, or the installed PyAV has no decoder for its codec.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._av = import_av()
        if not path.is_file():
            raise DataSetNotFound(f"There is no video '{path}', which the data set names.")
        try:
            # With the name of the protocol: the first part of a name with a colon would be one.
            self._container = self._av.open(f"file:{path}", options=_OPTIONS)
        except (self._av.error.FFmpegError, ValueError, OSError) as error:
            raise UndecodableVideo(f"'{path}' is no video that can be read ({_reason(error)}).") from error
        try:
            self._read_packets()
        except BaseException:
            self._container.close()
            raise
        self._decoded: Iterator[Any] = iter(())
        self._current: Any = None

    def _read_packets(self) -> None:
        if not self._container.streams.video:
            raise UndecodableVideo(f"'{self.path}' holds no pictures.")
        self._stream = stream = self._container.streams.video[0]
        if stream.codec_context is None:
            raise UndecodableVideo(
                f"'{self.path}' cannot be decoded: the installed PyAV ({self._av.__version__}) has no decoder for its "
                "codec; convert the video to H.264 or AV1."
            )
        self.codec: str = stream.codec_context.codec.canonical_name
        self.size: tuple[int, int] = (stream.codec_context.height, stream.codec_context.width)
        stamps, keys, read, size = array("q"), array("q"), 0, self.path.stat().st_size
        try:
            for packet in self._container.demux(stream):
                read += packet.size
                if read > size:
                    raise UndecodableVideo(
                        f"'{self.path}' is damaged: it has {size:,} bytes, and pictures of more than {read:,} bytes."
                    )
                if packet.pts is not None and not packet.is_discard:
                    stamps.append(packet.pts)
                    if packet.is_keyframe:
                        keys.append(packet.pts)
        except (self._av.error.FFmpegError, ValueError) as error:
            if isinstance(error, UndecodableVideo):
                raise
            raise UndecodableVideo(f"'{self.path}' is damaged ({_reason(error)}).") from error
        if not stamps:
            raise UndecodableVideo(f"'{self.path}' holds no pictures.")
        self._stamps, self._keys = np.sort(stamps), np.sort(keys)
        self.times: NDArray[np.float64] = self._stamps.astype(np.float64) * float(stream.time_base)

    def __enter__(self) -> VideoFile:
        return self

    def __exit__(self, _t: type[BaseException] | None, _v: BaseException | None, _tb: TracebackType | None) -> None:
        self.close()

    def close(self) -> None:
        """Close the file."""
        self._container.close()

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
        after = int(np.searchsorted(self.times, seconds))
        near = slice(max(after - 1, 0), after + 1)
        nearest = near.start + int(np.abs(self.times[near] - seconds).argmin())
        if not abs(self.times[nearest] - seconds) <= tolerance:
            raise DamagedDataSet(
                f"'{self.path}' has no picture at {seconds:.4f} s: its {len(self.times)} pictures are at "
                f"{self.times[0]:.4f} to {self.times[-1]:.4f} s, the nearest at {self.times[nearest]:.4f} s."
            )
        frame = self._frame(int(self._stamps[nearest]))
        if frame.is_corrupt:
            raise UndecodableVideo(f"'{self.path}' is damaged: the picture at {seconds:.4f} s cannot be decoded whole.")
        if (frame.height, frame.width) != self.size:
            raise UndecodableVideo(
                f"'{self.path}' is damaged: the picture at {seconds:.4f} s has {frame.width} x {frame.height} pixels, "
                f"and the file says {self.size[1]} x {self.size[0]}."
            )
        return np.ascontiguousarray(frame.to_ndarray(format="rgb24"))

    def _frame(self, stamp: int) -> Any:
        """Return the decoded frame with exactly this time stamp."""
        key = int(np.searchsorted(self._keys, stamp, side="right")) - 1
        earliest = max(key - _EARLIER_KEYS, 0)
        if not self._is_ahead(stamp, key):
            self._seek(max(key, 0))
        while True:
            while self._current is not None and self._current.pts < stamp:
                self._advance()
            if self._current is not None and self._current.pts == stamp:
                return self._current
            # The decoder began behind the frame, or lost it: begin at an earlier key frame.
            if key <= earliest:
                seconds = stamp * float(self._stream.time_base)
                raise UndecodableVideo(f"'{self.path}' is damaged: no picture comes out for {seconds:.4f} s.")
            key -= 1
            self._seek(key)

    def _is_ahead(self, stamp: int, key: int) -> bool:
        """Whether decoding on reaches a frame, with no later place to begin."""
        if self._current is None or self._current.pts > stamp:
            return False
        return key < 0 or self._current.pts >= self._keys[key] or self._current.pts == stamp

    def _seek(self, key: int) -> None:
        target = int(self._keys[key]) if key < len(self._keys) else int(self._stamps[0])
        try:
            self._container.seek(target, stream=self._stream, backward=True, any_frame=False)
        except (self._av.error.FFmpegError, ValueError) as error:
            raise UndecodableVideo(f"'{self.path}' is damaged ({_reason(error)}).") from error
        self._decoded = self._container.decode(self._stream)
        self._advance()

    def _advance(self) -> None:
        """Decode the next frame; None at the end of the file."""
        try:
            self._current = next((frame for frame in self._decoded if frame.pts is not None), None)
        except (self._av.error.FFmpegError, ValueError) as error:
            raise UndecodableVideo(f"'{self.path}' is damaged ({_reason(error)}).") from error


def _reason(error: BaseException) -> str:
    text = (getattr(error, "strerror", None) or str(error)).strip()
    return text.splitlines()[0].rstrip(".") if text else type(error).__name__
