"""Hostile videos: MP4 files whose lists say much, and pictures of other sizes than the file says."""

from __future__ import annotations

import struct
from collections.abc import Callable, Sequence
from pathlib import Path

from tests.thorough.hostile_checkpoints.hostile_files import sparse
from tests.thorough.hostile_data_sets.made import VIDEO, Case, hostile
from tests.thorough.hostile_data_sets.mp4_boxes import LISTS, box, exchange, find
from tests.thorough.hostile_runs import Make


def changed(change: Callable[[bytes], bytes]) -> Make:
    def edit(robot: Path) -> None:
        path = robot / VIDEO
        path.write_bytes(change(path.read_bytes()))

    return hostile(edit, video=True)


def samples(count: int, size: int, chunks: Sequence[int] = (48,)) -> Make:
    """Samples of one size, in chunks that begin at these bytes."""

    def change(content: bytes) -> bytes:
        for new in (
            box("stsz", 0, size, count),
            box("stts", 0, 1, count, 1),
            box("ctts", 0, 0),
            box("stsc", 0, 1, 1, count // len(chunks), 1),
            box("stco", 0, len(chunks), *chunks),
        ):
            content = exchange(content, (*LISTS, new[4:8].decode()), new)
        return content

    return changed(change)


def listed(kind: str, *numbers: int) -> Make:
    return changed(lambda content: exchange(content, (*LISTS, kind), box(kind, *numbers)))


def fragment(count: int) -> Make:
    """Samples without sizes in a fragment behind the file."""

    def change(content: bytes) -> bytes:
        run = box("tfhd", 0x020038, 1, 1024, 1, 0) + box("trun", 1, count, 0)
        moof = box("moof", content=box("mfhd", 0, 1) + box("traf", content=run))
        begin, end = find(content, ("moov",))
        moov = content[begin + 8 : end] + box("mvex", content=box("trex", 0, 1, 1, 1024, 1, 0))
        return content[:begin] + box("moov", content=moov) + content[end:] + moof + box("mdat", content=bytes(5000))

    return changed(change)


def encoded(codec: str, width: int, height: int, says: tuple[int, int] | None = None) -> Make:
    """A video of black pictures; says: the size in the header of the file."""

    def make(robot: Path) -> None:
        import av

        form = "yuvj420p" if codec == "mjpeg" else "yuv420p"
        with av.open(str(robot / VIDEO), "w") as output:
            stream = output.add_stream(codec, rate=10, options={"preset": "ultrafast"} if codec == "libx264" else {})
            stream.width, stream.height, stream.pix_fmt = width, height, form
            for number in range(4):
                frame = av.VideoFrame(width, height, form)
                for plane in frame.planes:
                    plane.update(bytes(plane.buffer_size))
                frame.pts = number
                output.mux(stream.encode(frame))
            output.mux(stream.encode())
        if says is not None:
            content = (robot / VIDEO).read_bytes()
            at = content.index(b"avc1", find(content, (*LISTS, "stsd"))[0]) + 4 + 24
            (robot / VIDEO).write_bytes(content[:at] + struct.pack(">HH", *says) + content[at + 4 :])

    return hostile(make, video=True)


NO_VIDEO = "is no video that can be read"

VIDEOS: dict[str, Case] = {
    "a billion samples": Case(samples(10**9, 1), "holds no pictures"),
    "samples on the same bytes": Case(samples(3_000_000, 1, range(48, 3048)), "pictures of more than"),
    "a list of sizes that ends early": Case(listed("stsz", 0, 0, 5000), "holds no pictures"),
    "a list of a billion times": Case(listed("stts", 0, 10**9, 1, 1024), NO_VIDEO),
    "a list of a billion chunks": Case(listed("stsc", 0, 10**9, 1, 1, 1), NO_VIDEO),
    "a fragment of a billion samples": Case(fragment(10**9), NO_VIDEO),
    "a video with holes": Case(hostile(lambda robot: sparse(robot / VIDEO, 2**40), video=True), NO_VIDEO),
    "a playlist": Case(changed(lambda content: b"#EXTM3U\n#EXTINF:1,\nhttp://127.0.0.1/a.mp4\n"), NO_VIDEO),
}
