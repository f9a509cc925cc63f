"""Forms of stored rows for analysis_speed.py: the old one, which no reader of the package knows, and today's.

Stores of before had rows as float32 rounded to ten mantissa bits, lz4 after a bit shuffle, and all keys in one chunk.
"""

from __future__ import annotations

import json
import math
import os
import time
from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
from measurement import Table, measured, ratios, take_turns
from numpy.typing import NDArray

from vla_attention.schemas.layout import SiteLayout
from vla_attention.schemas.stores.byte_source import Folder, Memory
from vla_attention.schemas.stores.digest import CHECKSUM_BYTES, crc32c
from vla_attention.schemas.stores.reader import StoredEpisode
from vla_attention.schemas.stores.stored_array import StoredArray

#: Of the made-up rows of the part `chunks`, of one denoise step; of the logits.
REPLANS, LAYERS, SPREAD = 52, 4, 3.0
BITS = (4, 7, 10, 12, 23)


@dataclass(frozen=True)
class ChunkFile:
    """Compressed chunks in a file, read by pread, crc32c and Blosc and nothing else.

    Attributes:
        places: offset and length of each, without the checksum that follows it.
        at_once: how many neighbours are read at once.
        shape, dtype: of a decoded chunk.
    """

    path: Path
    places: tuple[tuple[int, int], ...]
    at_once: int
    shape: tuple[int, ...]
    dtype: np.dtype[Any]

    def chunks(self) -> Iterator[NDArray[Any]]:
        """The decoded chunks, one after the other in the same memory; ValueError for a wrong checksum."""
        from numcodecs import blosc

        groups = [self.places[i : i + self.at_once] for i in range(0, len(self.places), self.at_once)]
        ends = [sum(group[-1]) + CHECKSUM_BYTES for group in groups]
        memory = np.empty(max(end - group[0][0] for group, end in zip(groups, ends, strict=True)), np.uint8)
        values = np.empty(self.shape, self.dtype)
        with self.path.open("rb", buffering=0) as file:
            for group, end in zip(groups, ends, strict=True):
                first = group[0][0]
                os.preadv(file.fileno(), [memory[: end - first].data], first)
                for at, length in group:
                    frame, checksum = memory[at - first :][:length], memory[at - first + length :][:CHECKSUM_BYTES]
                    if crc32c(frame) != int.from_bytes(checksum.tobytes(), "little"):
                        raise ValueError(f"{self.path}: the checksum of the chunk at {at} does not fit")
                    blosc.decompress(frame, values)
                    yield values


def stored_chunks(episode: StoredEpisode) -> ChunkFile:
    """The chunks of the rows of an episode as they are stored."""
    about = episode.array("joint/rows").metadata
    path = Path(str(episode.folder)) / "joint/rows" / about.file
    assert about.shard_chunks is not None
    index = np.frombuffer(path.read_bytes()[-16 * about.shard_chunks - CHECKSUM_BYTES : -CHECKSUM_BYTES], "<u8")
    places = tuple((at, size - CHECKSUM_BYTES) for at, size in index.reshape(-1, 2).tolist())
    return ChunkFile(path, places, about.grid[-1], about.chunk_shape, about.dtype)


def old_chunks(episode: StoredEpisode, path: Path) -> ChunkFile:
    """Write the rows of an episode, means over the queries, in the old form: a chunk (replan, head, key) a layer."""
    from numcodecs import Blosc

    from vla_attention.schemas.precision import round_mantissa

    codec = Blosc(cname="lz4", clevel=5, shuffle=Blosc.BITSHUFFLE)
    replans, layers, steps, heads, queries, keys = episode.shape_of("joint/rows")
    rows = round_mantissa(episode.read("joint/rows"), 10).reshape(replans, layers * steps, heads * queries, keys)
    places, size = [], 0
    with path.open("wb") as file:
        for cell in range(layers * steps):
            encoded = codec.encode(np.ascontiguousarray(rows[:, cell]))
            file.write(encoded + crc32c(encoded).to_bytes(CHECKSUM_BYTES, "little"))
            places.append((size, len(encoded)))
            size += len(encoded) + CHECKSUM_BYTES
    return ChunkFile(path, tuple(places), 1, (replans, heads * queries, keys), np.dtype("<f4"))


@dataclass(frozen=True)
class Wanted:
    """What a loop computes of an episode: masses of groups, mean over the heads.

    Attributes:
        weights: (replan or 1, key, group).
        sums: what the rows of each layer and step add up to, (layer and step, replan); None: not compared.
    """

    weights: NDArray[np.float32]
    sums: NDArray[np.float32] | None

    def of_keys(self, keys: range) -> Wanted:
        """The same of the groups that have no other keys."""
        inside = self.weights[:, keys.start : keys.stop]
        alone = inside.sum(axis=(0, 1)) == self.weights.sum(axis=(0, 1))
        return Wanted(np.ascontiguousarray(inside[..., alone]), None)

    def masses(self, layers: Iterable[NDArray[np.float32]]) -> list[NDArray[np.float64]]:
        """Masses (replan, group) of each layer and step, from rows (replan, head, ..., key); a head has one query."""
        from vla_attention.analyze.measures.masses import masses
        from vla_attention.schemas.stores.content_rules import add_up

        found: list[NDArray[np.float64]] = []
        share = mean = np.empty(0, np.float32)
        for number, rows in enumerate(layers):
            parts = rows.reshape(len(rows), -1, rows.shape[-1])
            if not found:
                share = np.full((1, parts.shape[1]), 1 / parts.shape[1], np.float32)
                mean = np.empty((len(parts), 1, parts.shape[2]), np.float32)
            np.matmul(share, parts, out=mean)
            if self.sums is not None and not add_up(mean[:, 0], self.sums[number], 10):
                raise ValueError(f"rows {number} do not add up")
            found.append(masses(mean[:, 0], self.weights))
        return found


def stored_layers(array: StoredArray, keys: range | None = None) -> Iterator[NDArray[np.float32]]:
    """All layers and denoise steps of an array as the package reads them."""
    _, layers, steps, *_ = array.metadata.shape
    return array.layers([(layer, step) for layer in range(layers) for step in range(steps)], keys)


@dataclass(frozen=True)
class CountedFolder(Folder):
    """A folder that counts how often chunks are read, and their bytes."""

    counted: Counter[str] = field(default_factory=Counter)

    def read_into(self, memory: Memory, file: str, offset: int) -> int:
        """See `ByteSource`."""
        count = super().read_into(memory, file, offset)
        self.counted.update(reads=1, bytes=count)
        return count

    def of(self, layers: Iterable[object]) -> tuple[int, int]:
        """Reads and bytes of going through some layers."""
        self.counted.clear()
        for _ in layers:
            pass
        return self.counted["reads"], self.counted["bytes"]


def write_rows_array(folder: Path, rows: NDArray[np.float32], bits: int, keys: int | None = None) -> StoredArray:
    """Write rows (replan, layer, denoise, head, query, key) as captures do, into a folder that does not exist.

    keys: in a chunk; all unless given. The array's files are a `CountedFolder`.
    """
    import zarr

    from vla_attention.capture.store.site_writer import ShardWriter
    from vla_attention.schemas.stores.array_metadata import array_metadata
    from vla_attention.schemas.stores.seal import seal_episode
    from vla_attention.schemas.stores.sealed_files import SealedFiles
    from vla_attention.schemas.stores.store_format import ROW_AXES

    group = zarr.create_group(folder, zarr_format=3)
    writer = ShardWriter(group, folder, "rows", rows.shape[1:], bits, keys)
    for of_replan in rows:
        writer.append(of_replan)
    writer.finish(ROW_AXES)
    metadata = array_metadata(json.loads((folder / "rows/zarr.json").read_bytes()))
    return StoredArray("rows", metadata, SealedFiles(CountedFolder(folder), seal_episode(folder, "rows", "").files))


def size_of(array: StoredArray) -> int:
    """Bytes of an array's file."""
    return array.files.source.size(f"{array.name}/{array.metadata.file}")


def policies() -> dict[str, tuple[SiteLayout, int]]:
    """Name -> a site of a policy of full size, and the heads; weights are not needed."""
    from vla_attention.capture.policies.cosmos import config as cosmos
    from vla_attention.capture.policies.cosmos.latents import cross_layout, self_layout
    from vla_attention.capture.policies.pi import config as pi
    from vla_attention.capture.policies.pi.policy import site_layout

    found = {}
    for name, of_pi in (("pi0", pi.find_config("pi0_libero")), ("pi0.5", pi.find_config("pi05_libero"))):
        found[name] = (site_layout(of_pi), of_pi.action_expert.num_heads)
    of_cosmos = cosmos.find_config(cosmos.DEFAULT_CONFIG_NAME)
    for layout in (self_layout(of_cosmos), cross_layout(of_cosmos)):
        found[f"Cosmos, {layout.name}"] = (layout, of_cosmos.dit.num_heads)
    return found | _foreign_policies()


def _foreign_policies() -> dict[str, tuple[SiteLayout, int]]:
    """Those of other packages, from what their layouts read of configurations with the sizes of published ones."""
    from vla_attention.capture.torch_policies.layouts.openvla import openvla, openvla_oft
    from vla_attention.capture.torch_policies.layouts.pi0 import pi0_fast
    from vla_attention.capture.torch_policies.layouts.smolvla import smolvla

    made = SimpleNamespace
    features = {f"observation.images.camera{number}": made(shape=(3, 256, 256)) for number in (1, 2, 3)}
    action = made(shape=(7,))
    vlm_with_expert = made(
        **{"num_vlm_layers": 16, "num_expert_layers": 16, "self_attn_every_n_layers": 2, "num_attention_heads": 15},
        attention_mode="cross_attn",
        config=made(vision_config=made(patch_size=16), scale_factor=4),
    )
    of_smolvla = made(
        **{"image_features": features, "action_feature": action, "resize_imgs_with_padding": (512, 512)},
        **{"prefix_length": -1, "pad_language_to": "longest", "use_cache": True, "add_image_special_tokens": False},
        **{"tokenizer_max_length": 48, "chunk_size": 50, "num_steps": 10},
    )
    gemma = made(num_hidden_layers=18, num_attention_heads=8)
    paligemma = made(config=made(vision_config=made(patch_size=14), text_config=gemma))
    of_fast = made(
        **{"image_features": features, "action_feature": action, "image_resolution": (224, 224)},
        **{"tokenizer_max_length": 200, "max_decoding_steps": 256, "n_action_steps": 50},
    )
    llama = made(image_sizes=[224, 224], text_config=made(num_hidden_layers=32, num_attention_heads=32))
    open_vla = _policy("OpenVLAForActionPrediction", llama)
    layouts = {
        "SmolVLA": smolvla(_policy("SmolVLAPolicy", of_smolvla, made(vlm_with_expert=vlm_with_expert))),
        "pi0-FAST": pi0_fast(_policy("PI0FastPolicy", of_fast, made(paligemma_with_expert=made(paligemma=paligemma)))),
        "OpenVLA": openvla(open_vla),
        "OpenVLA-OFT": openvla_oft(open_vla),
    }
    found = {}
    for name, layout in layouts.items():
        for site in layout.sites:
            of_several = f"{name}, {site.keys.name}" if len(layout.sites) > 1 else name
            found[of_several] = (site.keys, layout.num_heads)
    return found


def _policy(kind: str, config: object, model: object = None) -> object:
    """A module of the class `kind` that has nothing but a configuration, and what its layout reads of its model."""
    from torch import nn

    policy = type(kind, (nn.Module,), {})()
    policy.config, policy.model = config, model
    return policy


def made_up_rows(heads: int, keys: int) -> NDArray[np.float32]:
    """Softmax of normal logits: (replan, layer, denoise, head, query, key)."""
    logits = np.random.default_rng(0).normal(0, SPREAD, (REPLANS, LAYERS, 1, heads, 1, keys))
    weights = np.exp(logits - logits.max(axis=-1, keepdims=True))
    rows: NDArray[np.float32] = (weights / weights.sum(axis=-1, keepdims=True)).astype(np.float32)
    return rows


def measure_chunks(scratch: Path, rounds: int) -> Table:
    """The part `chunks`."""
    from numcodecs import blosc

    blosc.use_threads = False  # as in the threads that episodes are read in
    rows = []
    for number, (name, (layout, heads)) in enumerate(policies().items()):
        folder = scratch / str(number)
        folder.mkdir()
        rows.append({"layout": name, "heads": str(heads), **_row_of_chunks(folder, layout, heads, rounds)})
    columns = {
        "layout": "layout",
        "heads": "heads",
        "keys": "keys",
        "in_chunk": "keys in a chunk",
        "chunks": "chunks a layer",
        "kb": "kB",
        "kb_times": "kB, times one chunk",
        "all_reads": "reads",
        "one_reads": "reads, one chunk",
        "all_ms": "ms",
        "one_ms": "ms, one chunk",
        "all_times": "ms, times one chunk",
        "text": "keys of the text (read)",
        "text_kb": "kB, text",
        "text_reads": "reads, text",
        "text_ms": "ms, text",
        "text_times": "ms, text, times one chunk",
    }
    note = (
        f"Of one layer at one denoise step of an episode of {REPLANS} replans: softmax of normal logits (standard "
        f"deviation {SPREAD:g}), no masked keys. Milliseconds are the processor's, to float32 and with checksums; "
        '"one chunk" has all keys. A file\'s index is read once for all layers, and not counted.'
    )
    return Table(columns, [{key: row.get(key) for key in columns} for row in rows], note)


def _row_of_chunks(folder: Path, layout: SiteLayout, heads: int, rounds: int) -> dict[str, Any]:
    """The row of a layout, without its name; what is the same with one chunk for all keys is left out."""
    from vla_attention.capture.store.codecs import keys_per_chunk

    values, of_chunk = made_up_rows(heads, layout.num_keys), keys_per_chunk(layout)
    array = write_rows_array(folder / "chunks", values, 10, of_chunk)
    text = max((span for span in layout.spans if span.kind == "text"), key=lambda span: span.num_keys, default=None)
    row: dict[str, Any] = {
        **{"keys": layout.num_keys, "in_chunk": of_chunk, "chunks": array.metadata.grid[-1]},
        **{"kb": size_of(array) / LAYERS / 1e3, "text": "none"},
    }
    read: dict[str, tuple[StoredArray, range | None]] = {"all": (array, None)}
    if text is not None:
        read["text"] = (array, array.metadata.whole_chunks(text.start, text.stop))
        row["text"] = f"{text.num_keys} ({len(read['text'][1] or ())})"
    if array.metadata.grid[-1] > 1:
        one = write_rows_array(folder / "one", values, 10)
        read["one"] = (one, None)
        row["kb_times"] = size_of(array) / size_of(one)
    calls = {kind: partial(_through, *of) for kind, of in read.items()}
    seconds = take_turns(calls, rounds, repeats=5, clock=time.process_time)
    for kind, (of_kind, keys) in read.items():
        source = of_kind.files.source
        assert isinstance(source, CountedFolder)
        reads, size = source.of(stored_layers(of_kind, keys))
        row |= {f"{kind}_reads": reads / LAYERS, f"{kind}_kb": size / LAYERS / 1e3}
        row[f"{kind}_ms"] = measured(seconds[kind], factor=1e3 / LAYERS)
        if "one" in read:
            row[f"{kind}_times"] = measured(ratios(seconds[kind], seconds["one"]))
    return row


def _through(array: StoredArray, keys: range | None = None) -> None:
    """Read all layers and let them go."""
    for _ in stored_layers(array, keys):
        pass


def measure_bits(scratch: Path, rounds: int) -> Table:
    """The part `bits`."""
    from numcodecs import blosc

    import vla_attention as va
    from vla_attention.schemas.stores.reader import open_store

    blosc.use_threads = False
    episodes = open_store(va.example("cubes")).episodes
    parts = [episode.read("joint/rows") for episode in episodes]
    # In one chunk, as large as those of captures are: (replan, 1, 1, layer x denoise x head, query, key).
    values = np.concatenate([part.reshape(len(part), 1, 1, -1, *part.shape[4:]) for part in parts])
    # The bits that storage rounded away are drawn: of rows as computed, too, they are as good as random.
    drawn = np.random.default_rng(0).uniform(-1, 1, values.shape) * 2.0**-11
    values = (values * (1 + drawn)).astype(np.float32)
    arrays = {bits: write_rows_array(scratch / f"bits {bits}", values, bits) for bits in BITS}
    calls = {str(bits): partial(_through, array) for bits, array in arrays.items()}
    seconds = take_turns(calls, rounds, repeats=50, clock=time.process_time)
    rows = [
        {
            "bits": str(bits),
            "stored": f"float{8 * array.metadata.dtype.itemsize}",
            "bytes": size_of(array) / values.size,
            "ns": measured(seconds[str(bits)], factor=1e9 / values.size),
        }
        for bits, array in arrays.items()
    ]
    columns = {"bits": "mantissa bits", "stored": "stored as", "bytes": "bytes a number", "ns": "ns a number"}
    note = (
        f"{values.size:,} numbers of {len(episodes)} episodes of the example store `cubes`, with bits beyond the "
        f"tenth drawn, in {math.prod(arrays[10].metadata.grid)} chunk; read to float32, with checksums."
    )
    return Table(columns, rows, note)
