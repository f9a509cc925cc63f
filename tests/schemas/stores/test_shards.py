"""The shard reader gives what zarr-python gives, notices damage, and leaves other layouts to zarr-python."""

import hashlib
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zarr
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st
from numcodecs import blosc
from zarr.codecs import BloscCodec, Crc32cCodec

from tests.kit.attacks import files_of, with_checksum
from tests.kit.examples import examples
from vla_attention.schemas.stores import shards
from vla_attention.schemas.stores.array_metadata import describe_array
from vla_attention.schemas.stores.byte_source import Folder
from vla_attention.schemas.stores.reader import open_store
from vla_attention.schemas.stores.seal import seal_episode
from vla_attention.schemas.stores.sealed_files import SealedFiles
from vla_attention.schemas.stores.shards import SealedShard, ShardedLayers
from vla_attention.schemas.stores.store_format import STORE_VERSION, CorruptEpisode
from vla_attention.testing.stores import reseal, write_store

AXES = ["replan", "layer", "denoise", "head", "query", "key"]


def write_array(folder: Path, values: np.ndarray, block: int, **changes) -> zarr.Array:
    settings = {
        "chunks": (block, 1, 1, *values.shape[3:]),
        "shards": (block, *values.shape[1:]),
        "compressors": (BloscCodec(cname="lz4", clevel=5, shuffle="bitshuffle", typesize=4), Crc32cCodec()),
        "fill_value": float("nan"),
        "config": {"write_empty_chunks": True},
        **changes,
    }
    array = zarr.create_array(
        folder, shape=values.shape, dtype="float32", dimension_names=AXES[: values.ndim], **settings
    )
    array[...] = values
    return array


def reader_of(folder: Path) -> ShardedLayers | None:
    """The reader of the array `rows` in a folder, which is sealed here."""
    files = SealedFiles(Folder(folder.parent), seal_episode(folder.parent, "made up", "a run", STORE_VERSION).files)

    def shard(file: str) -> SealedShard:
        found = files.shard(f"rows/{file}")
        assert found is not None
        return found

    try:
        metadata = describe_array((folder / "zarr.json").read_bytes())
    except CorruptEpisode:
        return None
    return ShardedLayers.of(metadata, shard)


@settings(max_examples=examples(8), deadline=None, phases=[Phase.generate], suppress_health_check=list(HealthCheck))
@given(
    shape=st.tuples(*(st.integers(1, high) for high in (9, 3, 2, 2, 2, 17))),
    block=st.integers(1, 10),
    blocks=st.integers(1, 3),
    separator=st.sampled_from(["/", "."]),
    seed=st.integers(0, 99),
)
def test_equals_zarr_python(tmp_path_factory, shape, block, blocks, separator, seed):
    folder = tmp_path_factory.mktemp("array") / "rows"
    values = np.random.default_rng(seed).random(shape, dtype=np.float32)
    keys = {"name": "default", "separator": separator}
    array = write_array(folder, values, block, shards=(block * blocks, *shape[1:]), chunk_key_encoding=keys)
    reader = reader_of(folder)
    assert reader is not None
    memory = reader.memory()
    for layer in range(shape[1]):
        for denoise in range(shape[2]):
            read = reader.read(layer, denoise)
            np.testing.assert_array_equal(read, values[:, layer, denoise])
            again = reader.read(layer, denoise, memory)
            np.testing.assert_array_equal(again, read)
            assert np.shares_memory(again, memory.values)
            np.testing.assert_array_equal(read, array[:, layer, denoise])


def fail(file: str) -> SealedShard:
    raise AssertionError(file)


def test_other_layouts_are_read_with_zarr_python(tmp_path, monkeypatch):
    episode = open_store(write_store(tmp_path / "a.zarr")).episodes[0]
    expected = episode.read("joint/rows")
    metadata = describe_array((episode.folder / "joint/rows/zarr.json").read_bytes())
    assert isinstance(ShardedLayers.of(metadata, fail), ShardedLayers)
    monkeypatch.setattr(ShardedLayers, "of", classmethod(lambda cls, metadata, shard_in: None))
    np.testing.assert_array_equal(episode.read_layer("joint/rows", 1, 0), expected[:, 1, 0])


def test_every_flipped_byte_of_a_chunk_or_the_index_is_noticed(tmp_path):
    episode = open_store(write_store(tmp_path / "a.zarr", tasks=(0,), episodes=1)).episodes[0]
    rows = episode.folder / "joint" / "rows"
    whole = {(i, j): episode.read_layer("joint/rows", i, j) for i in range(2) for j in range(2)}
    (file,) = (path for path in rows.rglob("*") if path.is_file() and path.name != "zarr.json")
    content = file.read_bytes()
    generator = np.random.default_rng(0)
    places = [*generator.integers(0, len(content), 40), len(content) - 1, len(content) - 5, len(content) - 60]
    for place in places:
        damaged = bytearray(content)
        damaged[place] ^= 1 << int(generator.integers(8))
        file.write_bytes(bytes(damaged))
        noticed = 0
        for i, j in whole:
            try:
                read = open_store(tmp_path / "a.zarr").episodes[0].read_layer("joint/rows", i, j)
            except CorruptEpisode:
                noticed += 1
            else:
                np.testing.assert_array_equal(read, whole[i, j])  # another chunk was hit
        assert noticed, place
    file.write_bytes(content[: len(content) // 2])
    with pytest.raises(CorruptEpisode, match=r"task000_episode000.*another size"):
        open_store(tmp_path / "a.zarr").episodes[0].read_layer("joint/rows", 0, 0)


def test_a_chunk_that_was_never_written_is_missing(tmp_path):
    values = np.full((4, 2, 1, 2, 1, 8), np.nan, dtype=np.float32)
    values[:, 0] = 0.5
    write_array(tmp_path / "rows", values, 4, config={"write_empty_chunks": False})
    reader = reader_of(tmp_path / "rows")
    assert reader is not None
    assert (reader.read(0, 0) == 0.5).all()
    with pytest.raises(CorruptEpisode, match="missing"):
        reader.read(1, 0)


#: What is in memory before a chunk is decoded into it; attention is never one of these.
STALE = (np.float32(7e7), np.float32(-3e5))


class MemoryWith:
    """numpy, whose `empty` gives arrays with this content."""

    def __init__(self, value: np.float32) -> None:
        self.value = value

    def __getattr__(self, name: str):
        return getattr(np, name)

    def empty(self, shape, dtype) -> np.ndarray:
        return np.full(shape, self.value, dtype=dtype)


def read_in_two_memories(episode: Path, layer: int, denoise: int, monkeypatch) -> np.ndarray | None:
    """The values of one layer, or None for `CorruptEpisode`; they must not depend on what was in memory before."""
    read = []
    for value in STALE:
        monkeypatch.setattr(shards, "np", MemoryWith(value))
        try:
            read.append(open_store(episode.parents[1]).episodes[0].read_layer("joint/rows", layer, denoise))
        except CorruptEpisode:
            continue
        finally:
            monkeypatch.undo()
    if not read:
        return None
    one, other = read
    np.testing.assert_array_equal(one.view(np.uint32), other.view(np.uint32))
    return one


def test_a_frame_that_decodes_to_fewer_bytes_leaves_nothing_of_the_memory(tmp_path, monkeypatch):
    """Checksums, index and seal are right: only the size of the decoded chunk says that something is wrong."""
    episode = write_store(tmp_path / "a.zarr", tasks=(0,), episodes=1) / "episodes/task000_episode000"
    (file,) = files_of(episode, "joint/rows")
    content = file.read_bytes()
    rows = open_store(tmp_path / "a.zarr").episodes[0].read_layer("joint/rows", 0, 0)
    short = blosc.compress(np.ascontiguousarray(rows[:1]), b"lz4", 5, blosc.BITSHUFFLE, typesize=4)
    file.write_bytes(replaced_chunk(content, 0, short))
    reseal(episode)
    assert read_in_two_memories(episode, 0, 0, monkeypatch) is None
    assert read_in_two_memories(episode, 1, 0, monkeypatch) is not None
    with pytest.raises(CorruptEpisode, match=r"header says \d+ decoded bytes; expected \d+"):
        open_store(tmp_path / "a.zarr").episodes[0].read_layer("joint/rows", 0, 0)
    with pytest.raises(CorruptEpisode, match=r"header says \d+ decoded bytes; expected \d+"):
        open_store(tmp_path / "a.zarr").episodes[0].read("joint/rows")


@pytest.mark.parametrize(
    ("entries", "problem"),
    [
        ({0: (10**6, 100)}, "outside"),
        ({0: (2**64 - 8, 16)}, "outside"),
        ({1: None}, "overlap"),
        ({0: (0, 4)}, "missing"),
    ],
)
def test_positions_that_cannot_be_are_refused(tmp_path, entries, problem):
    """An index with a right checksum and a right digest in the seal."""
    episode = write_store(tmp_path / "a.zarr", tasks=(0,), episodes=1) / "episodes/task000_episode000"
    (file,) = files_of(episode, "joint/rows")
    content = file.read_bytes()
    index = np.frombuffer(content[-68:-4], dtype="<u8").reshape(-1, 2).copy()
    for number, entry in entries.items():
        index[number] = index[0] if entry is None else entry
    changed = with_checksum(index.tobytes())
    file.write_bytes(content[:-68] + changed)
    change_seal(
        episode,
        lambda files: files["joint/rows/c.0.0.0.0.0.0"].update(
            index=hashlib.sha256(changed).hexdigest(), sha256=hashlib.sha256(content[:-68] + changed).hexdigest()
        ),
    )
    with pytest.raises(CorruptEpisode, match=f"joint/rows of episode task000_episode000.*{problem}"):
        open_store(tmp_path / "a.zarr").episodes[0].read_layer("joint/rows", 0, 0)


def test_an_index_that_was_not_sealed_is_refused_although_its_checksum_fits(tmp_path):
    episode = write_store(tmp_path / "a.zarr", tasks=(0,), episodes=1) / "episodes/task000_episode000"
    (file,) = files_of(episode, "joint/rows")
    content = file.read_bytes()
    index = np.frombuffer(content[-68:-4], dtype="<u8").reshape(-1, 2).copy()
    index[[0, 1]] = index[[1, 0]]
    file.write_bytes(content[:-68] + with_checksum(index.tobytes()))
    with pytest.raises(CorruptEpisode, match="its index was changed"):
        open_store(tmp_path / "a.zarr").episodes[0].read_layer("joint/rows", 0, 0)


def change_seal(episode: Path, change: Callable[[dict[str, Any]], object]) -> None:
    """Edit the files in a seal, and give it its right digest."""
    file = episode / "seal/zarr.json"
    document = json.loads(file.read_text())
    change(document["attributes"]["files"])
    rest = {name: value for name, value in document["attributes"].items() if name != "digest"}
    canonical = json.dumps(rest, sort_keys=True, separators=(",", ":")).encode()
    document["attributes"]["digest"] = hashlib.sha256(canonical).hexdigest()
    file.write_text(json.dumps(document))


def replaced_chunk(shard: bytes, number: int, frame: bytes) -> bytes:
    """A shard of four chunks with another frame in one place; all its checksums are right."""
    index = np.frombuffer(shard[-68:-4], dtype="<u8").reshape(-1, 2)
    chunks = [shard[int(start) : int(start + length)] for start, length in index]
    chunks[number] = with_checksum(frame)
    starts = np.cumsum([0, *(len(chunk) for chunk in chunks[:-1])])
    written = np.array([(start, len(chunk)) for start, chunk in zip(starts, chunks, strict=True)], dtype="<u8")
    return b"".join(chunks) + with_checksum(written.tobytes())


@pytest.fixture(scope="module")
def crafted(tmp_path_factory) -> Path:
    store = write_store(tmp_path_factory.mktemp("crafted") / "a.zarr", tasks=(0,), episodes=1, heads=(0, 1, 2))
    return store / "episodes/task000_episode000"


@pytest.mark.thorough
@settings(max_examples=examples(15), deadline=None, suppress_health_check=list(HealthCheck))
@given(data=st.data())
def test_a_changed_frame_with_right_checksums_gives_the_exact_values_or_an_error(crafted, data):
    """With the seal as it was, every changed chunk is refused. Sealed again, it is refused or decoded to its end."""
    (file,) = files_of(crafted, "joint/rows")
    content, seal = file.read_bytes(), (crafted / "seal/zarr.json").read_bytes()
    index = np.frombuffer(content[-68:-4], dtype="<u8").reshape(-1, 2)
    number = data.draw(st.integers(0, 3))
    frame = bytearray(content[int(index[number, 0]) : int(index[number].sum()) - 4])
    kind = data.draw(st.sampled_from(["bytes", "a size in the header", "cut off", "grown"]))
    if kind == "bytes":
        for place in data.draw(st.lists(st.integers(0, len(frame) - 1), min_size=1, max_size=4)):
            frame[place] ^= data.draw(st.integers(1, 255))
    elif kind == "a size in the header":
        place = data.draw(st.sampled_from([4, 8, 12, 16]))
        size = data.draw(st.integers(0, 2 * len(frame)) | st.sampled_from([2**31 - 1, 2**31, 2**32 - 1]))
        frame[place : place + 4] = size.to_bytes(4, "little")
    elif kind == "cut off":
        del frame[data.draw(st.integers(0, len(frame) - 1)) :]
    else:
        frame += data.draw(st.binary(min_size=1, max_size=40))
    exact = {(i, j): open_store(crafted.parents[1]).episodes[0].read_layer("joint/rows", i, j) for i, j in PAIRS}
    try:
        changed = replaced_chunk(content, number, bytes(frame))
        file.write_bytes(changed)
        with pytest.MonkeyPatch.context() as monkeypatch:
            for pair in PAIRS:
                read = read_in_two_memories(crafted, *pair, monkeypatch)
                assert read is None or np.array_equal(read, exact[pair])
                assert read is None or changed == content or pair != PAIRS[number]
            reseal(crafted)
            for pair in PAIRS:
                read = read_in_two_memories(crafted, *pair, monkeypatch)
                assert pair == PAIRS[number] or np.array_equal(read, exact[pair])
    finally:
        file.write_bytes(content)
        (crafted / "seal/zarr.json").write_bytes(seal)


#: Layer and denoise step of each chunk, in the index's order.
PAIRS = [(0, 0), (0, 1), (1, 0), (1, 1)]
