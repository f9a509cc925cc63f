"""Hostile checkpoints of Cosmos Policy: files of torch.save, pickled text embeddings, statistics."""

from __future__ import annotations

import atexit
import pickle
import shutil
import struct
import zipfile
from collections.abc import Callable
from functools import cache
from pathlib import Path
from tempfile import mkdtemp

import torch

from tests.kit.cosmos_checkpoint import WEIGHTS_NAME, write_dummy_folder
from tests.thorough.hostile_checkpoints.hostile_files import (
    NO_TORCH_FILE,
    TRACE,
    Case,
    Execute,
    Make,
    deep,
    edit,
    executing_pickle,
    hash_bomb,
    link,
    old_torch,
    sparse,
    table_bomb,
    text,
    torch_zip,
)
from vla_attention.capture.policies.cosmos.embedded import DUMMY_CONFIG
from vla_attention.capture.policies.cosmos.locate import EMBEDDINGS_NAME, STATISTICS_NAME, VAE_NAME


@cache
def dummy() -> Path:
    """A checkpoint of test size, written once in a process."""
    folder = Path(mkdtemp(prefix="hostile-"))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    return write_dummy_folder(folder / "dummy", DUMMY_CONFIG, ["touch the red cube"])


def made(change: Callable[[Path], object], folder: Path) -> list[str]:
    checkpoint = folder / "checkpoint"
    shutil.copytree(dummy(), checkpoint)
    change(checkpoint)
    arguments = ["cosmos", "--ckpt-path", str(checkpoint), "--device", "cpu", "--task-suite", "cubes", "--task-id", "0"]
    return [*arguments, "--num-episodes", "1", "--output", str(folder / "store.zarr")]


def weights(change: Callable[[Path], object]) -> Make:
    return lambda folder: made(lambda checkpoint: change(checkpoint / WEIGHTS_NAME), folder)


def embeddings(change: Callable[[Path], object]) -> Make:
    return lambda folder: made(lambda checkpoint: change(checkpoint / EMBEDDINGS_NAME), folder)


def statistics(change: Callable[[Path], object]) -> Make:
    return lambda folder: made(lambda checkpoint: change(checkpoint / STATISTICS_NAME), folder)


def pickled(content: bytes, method: int = zipfile.ZIP_STORED) -> Make:
    return weights(lambda path: torch_zip(path, content, method))


def saved(change: Callable[[dict[str, object]], object]) -> Make:
    """Weights of the dummy with a change, as torch.save writes them."""

    def save(path: Path) -> None:
        state = dict(torch.load(path, weights_only=False))
        change(state)
        torch.save(state, path)

    return weights(save)


def execute_through_storage(path: Path) -> None:
    """Text embeddings whose storage, a file of torch.save in the pickle, executes."""
    inner = executing_pickle(path.parent.parent)
    name = b"ctorch.storage\n_load_from_bytes\n"
    path.write_bytes(b"\x80\x03}" + text("a") + name + b"B" + struct.pack("<I", len(inner)) + inner + b"\x85Rs.")


def claims(path: Path) -> None:
    """A file before 1.6 with a storage of 10^15 numbers."""
    storage = (
        b"("
        + text("storage")
        + b"ctorch\nFloatStorage\n"
        + text("0")
        + text("cpu")
        + b"\x8a\x07"
        + (10**15).to_bytes(7, "little")
        + b"NtQ"
    )
    rebuilt = b"ctorch._utils\n_rebuild_tensor_v2\n(" + storage + b"K\x00))\x89}tR"
    old_torch(path, b"\x80\x02}" + text("net.a") + rebuilt + b"s.")


def huge_blocks(state: dict[str, object]) -> None:
    state["net.blocks.999999999.self_attn.q_norm.weight"] = torch.zeros(1)


def claimed_width(state: dict[str, object]) -> None:
    state["net.x_embedder.proj.1.weight"] = torch.zeros(1).expand(10**6, 10**6)


def whole_numbers(state: dict[str, object]) -> None:
    state["net.x_embedder.proj.1.weight"] = torch.zeros(8, 8, dtype=torch.int8)


EXECUTES = weights(lambda path: torch_zip(path, executing_pickle(path.parent.parent)))

COSMOS: dict[str, Case] = {
    "weights that execute": Case(EXECUTES, r"it asks for \w+\.system.*nothing of it was executed"),
    "an image encoder that executes": Case(
        lambda folder: made(lambda path: torch_zip(path / VAE_NAME, executing_pickle(folder)), folder),
        r"asks for \w+\.system",
    ),
    "text that executes": Case(
        embeddings(lambda path: path.write_bytes(pickle.dumps({"a": Execute(path.parent.parent / TRACE)}))),
        r"asks for \w+\.system.*nothing of it was executed",
    ),
    "text whose storage executes": Case(embeddings(execute_through_storage), r"refused as text .* GLOBAL \w+\.system"),
    "entry 4 billion of a table": Case(
        embeddings(lambda path: path.write_bytes(table_bomb())),
        "with 4 GB .* asked for more memory",
    ),
    "a text of 10 GB": Case(
        embeddings(lambda path: sparse(path, 10**10 + 20, b"\x80\x04\x8d" + (10**10).to_bytes(8, "little"))),
        "with 4 GB .* asked for more memory",
    ),
    "a compressed pickle": Case(pickled(b"\x80\x02" + b"0" * 50_000_000, zipfile.ZIP_DEFLATED), NO_TORCH_FILE),
    "a storage of 10^15 numbers": Case(weights(claims), NO_TORCH_FILE),
    "a tensor with a step of 0": Case(saved(claimed_width), "whose numbers it does not hold"),
    "text embeddings of 5 GB": Case(embeddings(lambda path: sparse(path, 5 * 10**9)), "refused as text embeddings"),
    "a key that is hashed for an hour": Case(pickled(hash_bomb()), NO_TORCH_FILE),
    "block 999,999,999": Case(saved(huge_blocks), "1 extra: blocks.999999999|missing"),
    "quantized weights": Case(saved(whole_numbers), r"no floating point numbers.*\(torch.int8\)"),
    "weights that are a link": Case(weights(lambda path: link(path, "/etc/hostname")), "leads out of its folder"),
    "deep statistics": Case(statistics(lambda path: path.write_text(deep())), "nested too deep"),
    "ranges with NaN": Case(
        statistics(lambda path: edit(path, lambda content: content.update(actions_min=[float("nan")] * 7))),
        "finite numbers",
    ),
}
