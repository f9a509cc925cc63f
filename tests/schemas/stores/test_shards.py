"""The shard reader gives what zarr-python gives, notices damage, and leaves other layouts to zarr-python."""

import json
from pathlib import Path

import numpy as np
import pytest
import zarr
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st
from zarr.codecs import BloscCodec, Crc32cCodec

from tests.kit.attacks import files_of, with_checksum
from tests.kit.examples import examples
from tests.kit.stores import write_store
from vla_attention.schemas.stores.array_metadata import describe_array
from vla_attention.schemas.stores.byte_source import Folder
from vla_attention.schemas.stores.reader import open_store
from vla_attention.schemas.stores.seal import seal_episode
from vla_attention.schemas.stores.sealed_files import SealedFiles
from vla_attention.schemas.stores.shards import SealedShard, ShardedLayers
from vla_attention.schemas.stores.store_format import CorruptEpisode

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
    files = SealedFiles(Folder(folder.parent), seal_episode(folder.parent, "made up", "a run").files)

    try:
        metadata = describe_array(json.loads((folder / "zarr.json").read_bytes()))
    except CorruptEpisode:
        return None
    return ShardedLayers.of(metadata, lambda file: files.shard(f"rows/{file}", metadata.shard_chunks or 0))


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
    metadata = describe_array(json.loads((episode.folder / "joint/rows/zarr.json").read_bytes()))
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


def test_an_index_that_was_not_sealed_is_refused_although_its_checksum_fits(tmp_path):
    episode = write_store(tmp_path / "a.zarr", tasks=(0,), episodes=1) / "episodes/task000_episode000"
    (file,) = files_of(episode, "joint/rows")
    content = file.read_bytes()
    index = np.frombuffer(content[-68:-4], dtype="<u8").reshape(-1, 2).copy()
    index[[0, 1]] = index[[1, 0]]
    file.write_bytes(content[:-68] + with_checksum(index.tobytes()))
    with pytest.raises(CorruptEpisode, match="its index was changed"):
        open_store(tmp_path / "a.zarr").episodes[0].read_layer("joint/rows", 0, 0)
