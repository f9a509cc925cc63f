"""What is done with bytes from anywhere, a function for each parser: it returns, or raises a `UserError`.

Any other exception is a finding. `benchmarks/reliability_fuzz.py` gives them bytes that atheris makes up, the tests in
tests/thorough the files of its corpus and documents that hypothesis changes. They need neither torch nor a simulator.
Bytes that a checksum or a digest would refuse at once get the right one, so that what is behind it is reached.
"""

from __future__ import annotations

import json
import struct
import tempfile
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from tests.kit.attacks import with_checksum
from tests.kit.lerobot_data_sets import encoded, made_up_episodes, numbered_picture, write_data_set
from tests.kit.stores import StoreSpec, small_effects, small_steps, write_store
from tests.kit.tokens import small_tokens
from vla_attention.analyze.published.results_reader import read_results_file
from vla_attention.capture.replay.data_set_files import INFO, read_info
from vla_attention.capture.replay.data_set_reader import PictureRefused, decode_picture
from vla_attention.schemas.errors import UserError
from vla_attention.schemas.groupings.grouping import Grouping, read_grouping_file
from vla_attention.schemas.groupings.resolve import check_names, resolve
from vla_attention.schemas.groupings.selector_parser import atoms_of, parse_selector
from vla_attention.schemas.groupings.vocabulary import EpisodeTokens, collect_vocabulary
from vla_attention.schemas.jsonable import to_json
from vla_attention.schemas.stores.array_metadata import ArrayMetadata, array_metadata
from vla_attention.schemas.stores.byte_source import Memory
from vla_attention.schemas.stores.digest import bytes_digest, crc32c
from vla_attention.schemas.stores.episode_checks import content_problems
from vla_attention.schemas.stores.reader import StoredEpisode, open_store
from vla_attention.schemas.stores.root import attributes_in
from vla_attention.schemas.stores.seal import SEAL_FILE, read_seal, seal_document
from vla_attention.schemas.stores.sealed_files import SealedFiles
from vla_attention.schemas.stores.shards import index_size
from vla_attention.schemas.stores.store_format import FileRecord
from vla_attention.schemas.stores.stored_array import StoredArray

SPEC = StoreSpec(
    tasks=(0,),
    episodes=1,
    replans=3,
    layers=(0, 2),
    heads=(0,),
    coverage=False,
    frames=False,
    plant_effects=small_effects,
    plant_steps=small_steps,
)
_ROWS = "joint/rows"
#: A pattern of bytes that no decoded chunk has; what was there before must never pass for attention.
_UNTOUCHED = 0x7FC12345


@dataclass(frozen=True)
class InMemory:
    """A file in memory, as a `ByteSource`, under whatever name it is asked for."""

    content: bytes

    def whole(self, file: str) -> bytes:
        return self.content

    def part(self, file: str, offset: int, length: int) -> bytes:
        return self.content[offset : offset + length]

    def read_into(self, memory: Memory, file: str, offset: int) -> int:
        content = self.part(file, offset, len(memory))
        memory[: len(content)] = np.frombuffer(content, np.uint8)
        return len(content)

    def size(self, file: str) -> int:
        return len(self.content)


@cache
def _folder() -> Path:
    """A folder of this process, in memory where the system has one."""
    shared = Path("/dev/shm")
    found = tempfile.TemporaryDirectory(prefix="vla-fuzz-", dir=shared if shared.is_dir() else None)
    _KEPT.append(found)
    return Path(found.name)


#: Folders that are removed at the end of the process.
_KEPT: list[tempfile.TemporaryDirectory[str]] = []


@cache
def _store(name: str) -> Path:
    """A small store of one episode that a target changes, and nobody else."""
    return write_store(_folder() / name / "a.zarr", spec=SPEC)


@cache
def _tokens() -> EpisodeTokens:
    return small_tokens(2, 0, 0)


def _resolve(grouping: Grouping) -> None:
    tokens = _tokens()
    check_names(grouping, collect_vocabulary([tokens]))
    resolve(grouping, tokens)


def selectors(content: bytes) -> None:
    """A selector of a command line."""
    text = content.decode("utf-8", "surrogateescape")
    atoms_of(parse_selector(text))
    _resolve(Grouping("fuzzed", {"a": (text,), "rest": ("*",)}))


def groupings(content: bytes) -> None:
    """A TOML file of groups, and its groups on an episode's keys."""
    path = _folder() / "grouping.toml"
    path.write_bytes(content)
    _resolve(read_grouping_file(path))


def results(content: bytes) -> None:
    """A results file."""
    path = _folder() / "attention_ratio_results_libero_10.json"
    path.write_bytes(content)
    read_results_file(path)


def roots(content: bytes) -> None:
    """The `zarr.json` of a store."""
    store = _store("roots")
    (store / "zarr.json").write_bytes(content)
    for episode in open_store(store).episodes:
        _ = episode.attributes


def seals(content: bytes) -> None:
    """A seal, under its right digest if it is JSON."""
    with suppress(ValueError, RecursionError):
        content = seal_document(attributes_in(json.loads(content)))
    _read("seals", SEAL_FILE, content)


def attributes(content: bytes) -> None:
    """The `zarr.json` of an episode, sealed."""
    _read("attributes", "zarr.json", content)


def arrays(content: bytes) -> None:
    """The `zarr.json` of an array that is one chunk, sealed."""
    _read("arrays", "joint/atoms/zarr.json", content)


def sharded_arrays(content: bytes) -> None:
    """The `zarr.json` of the rows, sealed."""
    _read("sharded_arrays", f"{_ROWS}/zarr.json", content)


@cache
def _original(name: str) -> StoredEpisode:
    return open_store(_store(name)).episodes[0]


@cache
def _sealed_as(name: str) -> dict[str, Any]:
    """The seal of an episode before it is changed."""
    found: dict[str, Any] = to_json(read_seal(_store(name) / "episodes" / _original(name).name))
    return found


def _read(name: str, file: str, content: bytes) -> None:
    """Exchange a file of an episode, list it in the seal, and check the episode with everything that is in it."""
    episode = _original(name)
    folder, seal = _store(name) / "episodes" / episode.name, _sealed_as(name)
    (folder / file).write_bytes(content)
    if file != SEAL_FILE:
        record = {**seal["files"][file], "size": len(content), "sha256": bytes_digest(content)}
        (folder / SEAL_FILE).write_bytes(seal_document({**seal, "files": {**seal["files"], file: record}}))
    store = open_store(_store(name))
    found = replace(store.episodes[0], name=episode.name)
    list(content_problems(store.attributes, found))
    found.tokens(store.attributes, "joint")
    for array in found.attributes.arrays:
        found.read(array)


@cache
def _rows_metadata() -> ArrayMetadata:
    folder = _store("shards") / "episodes" / _original("shards").name
    return array_metadata(json.loads((folder / _ROWS / "zarr.json").read_bytes()))


def shards(content: bytes) -> None:
    """A shard of rows, with the checksums that belong to its bytes, read by layers."""
    metadata = _rows_metadata()
    count = metadata.shard_chunks
    assert count is not None
    size = index_size(count)
    if len(content) < size:
        content = bytes(size - len(content)) + content
    chunks, stored, checksums = bytearray(content[:-size]), content[-size:-4], list[bytes]()
    for offset, length in struct.iter_unpack("<QQ", stored):
        end = offset + length
        if length >= 4 and end <= len(chunks):
            chunks[end - 4 : end] = crc32c(bytes(chunks[offset : end - 4])).to_bytes(4, "little")
            checksums.append(bytes(chunks[end - 4 : end]))
        else:
            checksums.append(bytes(4))
    index = with_checksum(stored)
    content = bytes(chunks) + index
    record = FileRecord(len(content), bytes_digest(content), bytes_digest(index), b"".join(checksums).hex())
    array = StoredArray(_ROWS, metadata, SealedFiles(InMemory(content), {f"{_ROWS}/{metadata.file}": record}))
    for layer in range(metadata.shape[1]):
        for denoise in range(metadata.shape[2]):
            with suppress(UserError):
                memory = array.layer_memory()
                memory.view(np.uint32)[...] = _UNTOUCHED
                found = next(array.layers([(layer, denoise)], memory))
                if (found.view(np.uint32) == _UNTOUCHED).any():
                    raise AssertionError("a chunk that was not decoded passed for attention")


@cache
def _data_set(name: str) -> Path:
    """A small data set of two episodes that a target changes, and nobody else."""
    return write_data_set(_folder() / name, "v2.1", made_up_episodes((3, 2), size=(8, 20)))


def _read_data_set(name: str, file: str, content: bytes) -> None:
    """Exchange a file of a data set, and read what the meta files say."""
    folder = _data_set(name)
    (folder / file).write_bytes(content)
    for entry in read_info(folder).episodes.values():
        assert entry.length > 0


def data_set_infos(content: bytes) -> None:
    """The `info.json` of a data set."""
    _read_data_set("data_set_infos", INFO, content)


def episode_lines(content: bytes) -> None:
    """The episodes of a data set, a line of JSON each."""
    _read_data_set("episode_lines", "meta/episodes.jsonl", content)


def pictures(content: bytes) -> None:
    """A picture of a data set."""
    with suppress(PictureRefused):  # what a reader turns into a sentence
        assert decode_picture(content).ndim == 3


#: Every target by name.
TARGETS: dict[str, Callable[[bytes], None]] = {
    "selectors": selectors,
    "groupings": groupings,
    "results": results,
    "roots": roots,
    "seals": seals,
    "attributes": attributes,
    "arrays": arrays,
    "sharded_arrays": sharded_arrays,
    "shards": shards,
    "data_set_infos": data_set_infos,
    "episode_lines": episode_lines,
    "pictures": pictures,
}


def run(target: str, content: bytes) -> None:
    """Give bytes to a target; raises what must not be raised."""
    with suppress(UserError):
        TARGETS[target](content)


def seeds(target: str) -> list[bytes]:
    """Valid inputs, from which a fuzzer begins."""
    if target in _TEXTS:
        return [text.encode() for text in _TEXTS[target]]
    if target in _BYTES:
        return [make() for make in _BYTES[target]]
    store, data_set = _store("seeds"), _data_set("seeds")
    episode = store / "episodes" / _original("seeds").name
    return [
        {
            "roots": store / "zarr.json",
            "seals": episode / SEAL_FILE,
            "attributes": episode / "zarr.json",
            "arrays": episode / "joint/atoms/zarr.json",
            "sharded_arrays": episode / _ROWS / "zarr.json",
            "shards": next((episode / _ROWS).glob("c.*")),
            "data_set_infos": data_set / INFO,
            "episode_lines": data_set / "meta/episodes.jsonl",
        }[target].read_bytes()
    ]


_STEP = {"step": 10, "visual_mass": 0.5, "linguistic_mass": 0.0, "visual_fraction": 1.0, "linguistic_fraction": 0.0}
_EPISODE_OF_RESULTS = {
    "task_id": 0,
    "task_description": "put the bowl",
    "episode_idx": 0,
    "success": True,
    "num_steps": 5,
    "per_step_ratios": {"layer_0": [{**_STEP, "visual_linguistic_ratio": None}], "layers_avg": []},
    "summary": {"layer_0": {"num_steps": 1}},
}
_BYTES: dict[str, list[Any]] = {
    "pictures": [
        lambda: encoded("PNG", numbered_picture(5, 8, 20)),
        lambda: encoded("JPEG", numbered_picture(5, 8, 20)),
    ],
}
_TEXTS: dict[str, list[str]] = {
    "selectors": [
        'camera:base_0_rgb | (role:image & object:"plate_1") - keys:3-9',
        "patch:base_0_rgb[0:2, 1:3] & * - word:bowl",
        "span:prompt | word:'the bowl'",
    ],
    "groupings": [
        'name = "n"\noverlap = true\nallow_empty = ["b"]\n[groups]\na = ["word:bowl", "role:bos"]\nb = "*"\n'
        '[ratio]\nnumerator = ["a"]\ndenominator = ["b"]\n'
    ],
    "results": [json.dumps([_EPISODE_OF_RESULTS]), json.dumps(_EPISODE_OF_RESULTS)],
}
