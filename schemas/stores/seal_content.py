"""What a seal says: every file of an episode with its digests, the episode's name and its run. `seal.py` makes seals.

It is part of the store format, as `store_format.py` is: nothing here changes within a version.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

from vla_attention.schemas.errors import BadArgument
from vla_attention.schemas.limit_checks import check_at_most
from vla_attention.schemas.limits import EPISODE_FILES
from vla_attention.schemas.safe_text import check_inner_path

_CHECKSUMS = re.compile(r"([0-9a-fA-F]{8})*")
_DIGESTS = re.compile(r"([0-9a-fA-F]{16})*")


@dataclass(frozen=True)
class FileRecord:
    """Size in bytes and sha256 of a file of an episode.

    A shard, from which parts are read, has three fields more. `index` is the sha256 of the index at its end (with the
    index's checksum). `chunks` has the crc32c of every chunk, the 4 bytes at the chunk's end, in the index's order: 8
    hexadecimal digits each, without a separator; `00000000` for a chunk that was not written. `digests` has, in the
    same order, the first 8 bytes of the sha256 of every chunk as it is stored, with its crc32c: 16 hexadecimal digits
    each; zeros for a chunk that was not written.
    """

    size: int
    sha256: str
    index: str = ""
    chunks: str = ""
    digests: str = ""

    def __post_init__(self) -> None:
        """Check the size, the form of checksums and digests, and that there is one of each for every chunk."""
        if self.size < 0:
            raise BadArgument(f"a file of {self.size} bytes")
        if self.chunks and not _CHECKSUMS.fullmatch(self.chunks):
            raise BadArgument("the checksums of the chunks of a file are not 8 hexadecimal digits each")
        if self.digests and not _DIGESTS.fullmatch(self.digests):
            raise BadArgument("the digests of the chunks of a file are not 16 hexadecimal digits each")
        checksums, digests = len(self.chunks) // 8, len(self.digests) // 16
        if digests != checksums:
            raise BadArgument(f"a file has {digests} digests of chunks and {checksums} checksums; expected one of each")


@dataclass(frozen=True)
class EpisodeSeal:
    """What binds every file of an episode to the episode's name and to its run.

    `episode` is the name of the episode's group, `run` the digest of the run's configuration (`run_digest`), `files`
    every file of the episode but the seal itself, by its path. `copied_from` is the digest of the captured episode's
    seal, in a copy that leaves something out. `digest` is the sha256 of the other fields (`seal_digest`).
    """

    episode: str
    run: str
    files: dict[str, FileRecord]
    digest: str
    copied_from: str = ""

    def __post_init__(self) -> None:
        """Check the paths: a seal lists files inside of its episode's folder."""
        check_at_most("The number of files", len(self.files), EPISODE_FILES)
        for path in self.files:
            check_inner_path(path)
