"""What a seal says of the chunks of a shard, and that bits which were chosen to keep a checksum are found by it."""

from __future__ import annotations

import hashlib
import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
import pytest

import vla_attention as va
from tests.kit.attacks import FIRST, forge_chunk
from tests.kit.stores import StoreSpec, write_store
from vla_attention.analyze.__main__ import main as analyze
from vla_attention.schemas.stores import shards
from vla_attention.schemas.stores.digest import seal_digest
from vla_attention.schemas.stores.reader import open_store
from vla_attention.schemas.stores.store_format import CorruptEpisode

#: Two layers and two denoise steps: four chunks of 39 keys.
SPEC = StoreSpec(tasks=(0, 1), episodes=1, replans=9)
ROWS = "joint/rows/c.0.0.0.0.0.0"
#: A group that cuts a segment: its masses are read from the rows.
CORNER = "corner=patch:base_0_rgb[0:1,0:1]"
SENTENCE = f"chunk 2 of its {ROWS} does not agree with its seal, although its checksum fits"


@pytest.fixture(scope="module")
def original(tmp_path_factory) -> Path:
    return write_store(tmp_path_factory.mktemp("original") / "a.zarr", spec=SPEC)


@pytest.fixture
def path(original, tmp_path) -> Path:
    return Path(shutil.copytree(original, tmp_path / "a.zarr"))


@pytest.fixture
def forged(path) -> Path:
    file = path / "episodes" / FIRST / ROWS
    file.write_bytes(forge_chunk(file.read_bytes(), 2, 4, 39))
    return path


def records(path: Path, episode: str = FIRST) -> dict[str, dict[str, Any]]:
    found: dict[str, dict[str, Any]] = json.loads((path / "episodes" / episode / "seal/zarr.json").read_text())[
        "attributes"
    ]["files"]
    return found


def test_a_seal_has_the_first_bytes_of_the_sha256_of_every_chunk(original):
    of_shards = [file for file, record in records(original).items() if record["chunks"]]
    assert ROWS in of_shards
    for file in of_shards:
        content, record = (original / "episodes" / FIRST / file).read_bytes(), records(original)[file]
        count = len(record["chunks"]) // 8
        index = np.frombuffer(content[-16 * count - 4 : -4], dtype="<u8").reshape(-1, 2).tolist()
        stored = [content[start : start + length] for start, length in index]
        assert record["digests"] == "".join(hashlib.sha256(chunk).hexdigest()[:16] for chunk in stored)
        assert record["chunks"] == "".join(chunk[-4:].hex() for chunk in stored)


def masses(path: Path) -> pl.DataFrame:
    return va.open(path).analyze(groups=dict([CORNER.split("=")]))["tasks_groups"]


def refused_by(command: list[str], capsys) -> str:
    capsys.readouterr()
    code = analyze(command)
    said = capsys.readouterr()
    assert code == (1 if "verify" in command else 2), said
    return said.out + said.err


def test_bits_that_keep_the_checksum_are_refused_by_every_reading(forged, original, tmp_path, capsys, monkeypatch):
    monkeypatch.setenv("VLA_CACHE", "off")
    expected = masses(original)
    asked = ["--group", CORNER, "--no-plots", "--output", str(tmp_path / "out")]
    assert SENTENCE in refused_by([str(forged), *asked], capsys)
    assert analyze([str(forged), *asked, "--skip-corrupt"]) == 0
    assert FIRST in (tmp_path / "out/result.json").read_text()
    episode = open_store(forged).episodes[0]
    with pytest.raises(CorruptEpisode, match=SENTENCE):
        episode.read("joint/rows", np.s_[:, 1, 0])
    with pytest.raises(CorruptEpisode, match=f"its {ROWS} does not agree with its seal"):
        episode.read("joint/rows")
    assert ROWS in refused_by(["store", "verify", str(forged)], capsys)
    assert ROWS in refused_by(["store", "copy", str(forged), str(tmp_path / "c.zarr")], capsys)
    parts = [Path(shutil.copytree(forged, tmp_path / f"{task}.zarr")) for task in (0, 1)]
    for part, task in zip(parts, (1, 0), strict=True):
        shutil.rmtree(part / f"episodes/task00{task}_episode000")
    assert ROWS in refused_by(["store", "copy", *map(str, parts), "-o", str(tmp_path / "merged.zarr")], capsys)
    # Without the digests in the seal all would pass, unless row sums differ.
    monkeypatch.setattr(shards, "chunk_digest", lambda stored: b"")
    monkeypatch.setattr(shards.SealedShard, "_digest", lambda shard, number: b"")
    monkeypatch.setattr("vla_attention.analyze.stores.rows.add_up", lambda *_: True)
    assert not masses(forged).equals(expected)


def seal_with(path: Path, change: Callable[[dict[str, Any]], object]) -> None:
    """Change the record of the rows in a seal, which gets its right digest."""
    file = path / "episodes" / FIRST / "seal/zarr.json"
    document = json.loads(file.read_text())
    change(document["attributes"]["files"][ROWS])
    document["attributes"]["digest"] = seal_digest(document["attributes"])
    file.write_text(json.dumps(document))


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        (lambda record: record.pop("digests"), "0 digests of chunks and 4 checksums; expected"),
        (lambda record: record.update(digests=record["digests"][:48]), "3 digests of chunks and 4 checksums; expected"),
        (lambda record: record.update(digests="x" * 64), "are not 16 hexadecimal digits each"),
        (lambda record: record.update(chunks=""), "4 digests of chunks and 0 checksums; expected"),
        (lambda record: record.update(digests="0" * 64), "does not agree with its seal, although its checksum fits"),
    ],
)
def test_a_seal_with_other_digests_is_refused(path, capsys, change, sentence):
    seal_with(path, change)
    with pytest.raises(CorruptEpisode, match=sentence):
        open_store(path).episodes[0].read_layer("joint/rows", 1, 0)
    assert FIRST in refused_by(["store", "verify", str(path)], capsys)
    assert FIRST in refused_by(["store", "copy", str(path), str(path.parent / "c.zarr")], capsys)
