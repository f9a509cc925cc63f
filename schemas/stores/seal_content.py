"""What a seal says: every file of an episode with its digests, the episode's name and its run. `seal.py` makes seals.

It is part of the store format, as `store_format.py` is: nothing here changes within a version.
"""

from __future__ import annotations

import re
from typing import Any

from vla_attention.schemas.errors import BadArgument
from vla_attention.schemas.jsonable import Document
from vla_attention.schemas.limit_checks import check_at_most
from vla_attention.schemas.limits import EPISODE_FILES
from vla_attention.schemas.safe_text import check_inner_path

_CHECKSUMS = re.compile(r"([0-9a-f]{8})*")


class FileRecord(Document, frozen=True):
    """Size in bytes and sha256 of a file of an episode.

    Of a shard, from which parts are read: `index` is the sha256 of the index at its end, with the index's checksum, and
    `chunks` has the crc32c of every chunk, the 4 bytes at the chunk's end, in the index's order: 8 hexadecimal digits
    each, `00000000` for a chunk that was not written. A file of another episode may have an index of the same bytes.
    """

    size: int
    sha256: str
    index: str = ""
    chunks: str = ""

    def __post_init__(self) -> None:
        """Check the size and the form of the checksums."""
        if self.size < 0:
            raise BadArgument(f"a file of {self.size} bytes")
        if not _CHECKSUMS.fullmatch(self.chunks):
            raise BadArgument("the checksums of the chunks of a file are not 8 hexadecimal digits each")


class EpisodeSeal(Document, frozen=True):
    """What binds every file of an episode to the episode's name and to its run.

    `episode` is the name of the episode's group, `run` the digest of the run's configuration (`run_digest`), `files`
    every file of the episode but the seal itself, by its path. `documents` repeats what each `zarr.json` among them
    says, so that one small file opens an episode. `copied_from` is the digest of the captured episode's seal, in a copy
    that leaves something out. `digest` is the sha256 of the seal's file without the 64 digits of this digest.
    """

    episode: str
    run: str
    files: dict[str, FileRecord]
    documents: dict[str, Any]
    digest: str
    copied_from: str = ""

    def __post_init__(self) -> None:
        """Check the paths: a seal lists files inside of its episode's folder."""
        check_at_most("The number of files", len(self.files), EPISODE_FILES)
        for path in self.files:
            check_inner_path(path)
