"""Arrays are read as zarr-python reads them, and damage is noticed."""

import json
from pathlib import Path

import numpy as np
import pytest
import zarr
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st

from tests.kit.attacks import files_of, with_checksum
from tests.kit.examples import examples
from tests.kit.stores import write_array, write_store
from vla_attention.schemas.stores.array_metadata import array_metadata
from vla_attention.schemas.stores.byte_source import Folder
from vla_attention.schemas.stores.reader import open_store
from vla_attention.schemas.stores.seal import seal_episode
from vla_attention.schemas.stores.sealed_files import SealedFiles
from vla_attention.schemas.stores.store_format import CorruptEpisode
from vla_attention.schemas.stores.stored_array import StoredArray


def array_in(folder: Path) -> StoredArray:
    """The array in a folder, which is sealed here."""
    files = SealedFiles(Folder(folder.parent), seal_episode(folder.parent, "made up", "a run").files)
    return StoredArray(folder.name, array_metadata(json.loads((folder / "zarr.json").read_bytes())), files)


GENERATED = settings(
    max_examples=examples(8), deadline=None, phases=[Phase.generate], suppress_health_check=list(HealthCheck)
)


@GENERATED
@given(
    shape=st.lists(st.integers(0, 7), min_size=1, max_size=4).map(tuple),
    dtype=st.sampled_from(["uint8", "int64", "float32"]),
    data=st.data(),
)
def test_equals_zarr_python(tmp_path_factory, shape, dtype, data):
    folder = tmp_path_factory.mktemp("array") / "array"
    values = np.random.default_rng(0).integers(0, 250, shape).astype(dtype)
    chunks = tuple(data.draw(st.integers(1, max(1, extent) + 1)) for extent in shape)
    whole = tuple(chunk * max(1, -(-extent // chunk)) for extent, chunk in zip(shape, chunks, strict=True))
    write_array(folder, values, **data.draw(st.sampled_from([{"chunks": whole}, {"chunks": chunks, "shards": whole}])))
    first = data.draw(st.integers(0, shape[0]))
    stop = data.draw(st.integers(first, shape[0]))
    array = array_in(folder)
    np.testing.assert_array_equal(array.read(), values)
    np.testing.assert_array_equal(array.read(first, stop), zarr.open_array(folder)[first:stop])


@GENERATED
@given(
    shape=st.tuples(*(st.integers(1, high) for high in (9, 3, 2, 2, 2, 17))),
    chunk=st.tuples(st.integers(1, 10), st.integers(1, 18)),
    dtype=st.sampled_from([np.float16, np.float32]),
    data=st.data(),
)
def test_layers_are_those_of_the_whole_in_memory_that_is_used_again(tmp_path_factory, shape, chunk, dtype, data):
    block, of_key = chunk
    folder = tmp_path_factory.mktemp("array") / "rows"
    values = np.random.default_rng(block).random(shape, dtype=np.float32).astype(dtype)
    scale = 2.0**-15 if dtype == np.float16 else None
    shard = (-(-shape[0] // block) * block, *shape[1:-1], -(-shape[-1] // of_key) * of_key)
    attributes = {} if scale is None else {"scale_factor": scale}
    write_array(folder, values, chunks=(block, 1, 1, *shape[3:-1], of_key), shards=shard, attributes=attributes)
    array = array_in(folder)
    expected = values.astype(np.float32) * np.float32(scale or 1)
    np.testing.assert_array_equal(array.read(), expected)
    np.testing.assert_array_equal(array.read_stored(), values)
    places = [(layer, denoise) for layer in range(shape[1]) for denoise in range(shape[2])]
    begin = data.draw(st.integers(0, shape[-1] - 1))
    keys = array.metadata.whole_chunks(begin, data.draw(st.integers(begin + 1, shape[-1])))
    for wanted in (None, keys):
        first = None
        for (layer, denoise), read in zip(places, array.layers(places, wanted), strict=True):
            of_keys = slice(None) if wanted is None else slice(wanted.start, wanted.stop)
            np.testing.assert_array_equal(read, expected[:, layer, denoise, ..., of_keys])
            first = read if first is None else first
            assert np.shares_memory(read, first)


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
    with pytest.raises(CorruptEpisode, match="task000_episode000"):
        open_store(tmp_path / "a.zarr").episodes[0].read_layer("joint/rows", 0, 0)


def test_a_chunk_that_was_never_written_is_missing(tmp_path):
    values = np.full((4, 2, 1, 2, 1, 8), np.nan, dtype=np.float32)
    values[:, 0] = 0.5
    layout = {"chunks": (4, 1, 1, 2, 1, 8), "shards": values.shape, "config": {"write_empty_chunks": False}}
    write_array(tmp_path / "rows", values, **layout)
    array = array_in(tmp_path / "rows")
    assert (next(array.layers([(0, 0)])) == 0.5).all()
    with pytest.raises(CorruptEpisode, match="missing"):
        array.read()


def test_an_index_that_was_not_sealed_is_refused_although_its_checksum_fits(tmp_path):
    episode = write_store(tmp_path / "a.zarr", tasks=(0,), episodes=1) / "episodes/task000_episode000"
    (file,) = files_of(episode, "joint/rows")
    content = file.read_bytes()
    index = np.frombuffer(content[-68:-4], dtype="<u8").reshape(-1, 2).copy()
    index[[0, 1]] = index[[1, 0]]
    file.write_bytes(content[:-68] + with_checksum(index.tobytes()))
    with pytest.raises(CorruptEpisode, match="joint/rows"):
        open_store(tmp_path / "a.zarr").episodes[0].read_layer("joint/rows", 0, 0)
