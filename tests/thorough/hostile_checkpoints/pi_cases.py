"""Hostile checkpoints of the pi family: openpi's two formats, LeRobot's, statistics, tokenizers."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from safetensors.numpy import load_file, save_file

from tests.kit.paths import GOLDEN
from tests.thorough.hostile_checkpoints.hostile_files import (
    HUGE_NUMBER,
    Case,
    Make,
    deep,
    edit,
    link,
    pipe,
    safetensors,
    sparse,
    tensor,
)
from vla_attention.capture.policies.sentencepiece_model import EMBEDDED_TOKENIZER

VISION = "paligemma_with_expert.paligemma.model.vision_tower.vision_model."
PREPROCESSOR = "policy_preprocessor.json"
NORMALIZER = "policy_preprocessor_step_3_normalizer_processor.safetensors"


def arguments(checkpoint: Path, tokenizer: Path = EMBEDDED_TOKENIZER) -> list[str]:
    model = ["pi", "--checkpoint", str(checkpoint), "--tokenizer", str(tokenizer), "--device", "cpu"]
    store = checkpoint.parent / "store.zarr"
    return [*model, "--task-suite", "cubes", "--task-id", "0", "--num-episodes", "1", "--output", str(store)]


def copied(of: str, change: Callable[[Path], object], folder: Path, *, case: bool = True) -> list[str]:
    """A copy of a golden checkpoint with one change; case: with the file of sizes beside it."""
    checkpoint = folder / "checkpoint"
    shutil.copytree(GOLDEN / "pi" / of, checkpoint)
    if case:
        shutil.copyfile(GOLDEN / "pi" / Path(of).parent / "case.json", folder / "case.json")
    change(checkpoint)
    return arguments(checkpoint)


def openpi(change: Callable[[Path], object], **options: bool) -> Make:
    return partial(copied, "pi05_batch2/checkpoint_openpi_torch", change, **options)


def lerobot(change: Callable[[Path], object]) -> Make:
    return partial(copied, "pi05_batch2/checkpoint_lerobot", change)


def jax(change: Callable[[Path], object]) -> Make:
    return partial(copied, "pi0_batch2/checkpoint", change)


def weights(change: Callable[[Path], object]) -> Make:
    return openpi(lambda checkpoint: change(checkpoint / "model.safetensors"))


def config(change: Callable[[dict[str, Any]], object]) -> Make:
    return lerobot(lambda checkpoint: edit(checkpoint / "config.json", change))


def steps(change: Callable[[list[Any]], object]) -> Make:
    return lerobot(lambda checkpoint: edit(checkpoint / PREPROCESSOR, lambda content: change(content["steps"])))


def case_file(change: Callable[[dict[str, Any]], object]) -> Make:
    return openpi(lambda checkpoint: edit(checkpoint.parent / "case.json", change))


def stats(change: Callable[[Path], object]) -> Make:
    return openpi(lambda checkpoint: change(next(checkpoint.glob("assets/**/norm_stats.json"))))


def mean(value: object) -> Callable[[Path], object]:
    return lambda path: edit(path, lambda content: content["norm_stats"]["state"].update(mean=value))


def tokenizer(make: Callable[[Path], object]) -> Make:
    def made(folder: Path) -> list[str]:
        copied("pi05_batch2/checkpoint_openpi_torch", lambda _: make(folder / "tokenizer.model"), folder)
        return arguments(folder / "checkpoint", folder / "tokenizer.model")

    return made


def of_whole_numbers(path: Path) -> None:
    save_file({name: (100 * array).astype(np.int8) for name, array in load_file(path).items()}, path)


def many_blocks(checkpoint: Path) -> None:
    blocks = {f"{VISION}encoder.layers.{i}.x": tensor([0], 0) for i in range(5000)}
    named = {
        f"{VISION}embeddings.patch_embedding.weight": tensor([1152, 1, 14], 1152 * 14 * 4),
        f"{VISION}embeddings.position_embedding.weight": tensor([16], 1152 * 14 * 4 + 64, 1152 * 14 * 4),
        "time_mlp_in.weight": tensor([0], 0),
    }
    safetensors(checkpoint / "model.safetensors", named | blocks, bytes(1152 * 14 * 4 + 64))
    sizes = {
        "paligemma_variant": "gemma_2b",
        "action_expert_variant": "gemma_300m",
        "action_horizon": 10,
        "action_dim": 32,
    }
    (checkpoint / "config.json").write_text(json.dumps(sizes))


def not_finite(checkpoint: Path) -> None:
    statistics = load_file(checkpoint / NORMALIZER)
    statistics["observation.state.q01"][0] = np.nan
    save_file(statistics, checkpoint / NORMALIZER)


def leads_out(checkpoint: Path) -> None:
    (checkpoint.parent / "secret.json").write_text((checkpoint / "config.json").read_text())
    link(checkpoint / "config.json", "../secret.json")


def first_leaf(change: Callable[[dict[str, Any]], object]) -> Make:
    """Change the metadata of one array in the key-value store."""

    def made(checkpoint: Path) -> None:
        import tensorstore

        store = tensorstore.KvStore.open({"driver": "ocdbt", "base": f"file://{checkpoint / 'params'}/"}).result()
        key = next(key for key in store.list().result() if b"action_in_proj.kernel" in key and key.endswith(b".zarray"))
        content = json.loads(store[key])
        change(content)
        store[key] = json.dumps(content).encode()

    return jax(made)


def chunk_of_gigabytes(checkpoint: Path) -> None:
    """3 GB of zeros in 90 kB, in place of a chunk of 6 kB."""
    import numcodecs
    import tensorstore

    store = tensorstore.KvStore.open({"driver": "ocdbt", "base": f"file://{checkpoint / 'params'}/"}).result()
    key = next(key for key in store.list().result() if b"action_in_proj.kernel" in key and key.endswith(b"/0.0"))
    store[key] = 30 * numcodecs.Zstd(level=1).encode(bytes(100_000_000))


def manifest(change: Callable[[Path], object]) -> Make:
    return jax(lambda checkpoint: change(checkpoint / "params" / "manifest.ocdbt"))


PI: dict[str, Case] = {
    "a header of 2^63 bytes": Case(
        weights(lambda path: safetensors(path, {}, length=2**63)), "damaged or its copy incomplete"
    ),
    "overlapping tensors": Case(
        weights(lambda path: safetensors(path, {"a": tensor([2], 8), "b": tensor([2], 12, 4)}, bytes(12))), "damaged"
    ),
    "a tensor beyond the file": Case(
        weights(lambda path: safetensors(path, {"a": tensor([10**9], 4 * 10**9)}, bytes(8))), "damaged"
    ),
    "five thousand blocks": Case(openpi(many_blocks, case=False), "tensors are not those of the model"),
    "whole numbers for weights": Case(weights(of_whole_numbers), r"no floating point numbers.*\(I8\)"),
    "a pipe for weights": Case(weights(pipe), "no regular file"),
    "a link out of the checkpoint": Case(openpi(leads_out), "a link that leads out of its folder, to"),
    "deep JSON": Case(openpi(lambda path: (path / "config.json").write_text(deep())), "nested too deep"),
    "a number of 5,000 digits": Case(
        openpi(lambda path: (path / "config.json").write_text(HUGE_NUMBER)), "not valid JSON|digits"
    ),
    "JSON of 50 MB": Case(
        openpi(lambda path: sparse(path / "config.json", 50_000_000, b"{")), "has 50,?000,?000 bytes"
    ),
    "control characters in a type": Case(
        config(lambda content: content.update(type="\x1b[2J\u202e\nx")), r"family: '\\x1b\[2J\\u202e\\nx', not pi0"
    ),
    "a billion blocks": Case(
        case_file(lambda content: content["config"]["paligemma"].update(depth=10**9)),
        r"paligemma\.depth: Expected .* <= 500",
    ),
    "a billion empty cameras": Case(
        config(lambda content: content.update(empty_cameras=10**9)), "empty_cameras: Expected .* <= 64"
    ),
    "a step of somebody's code": Case(
        steps(lambda found: found.insert(0, {"class": "os.system"})), "step that is not supported: 'os.system'"
    ),
    "statistics outside of the checkpoint": Case(
        steps(lambda found: [step.update(state_file="../x") for step in found if "state_file" in step]),
        "which is not there",
    ),
    "statistics with NaN": Case(lerobot(not_finite), "hold NaN or infinity"),
    "a pipe for norm_stats.json": Case(stats(pipe), "no regular file"),
    "means with NaN": Case(stats(mean([float("nan")] * 8)), "NaN or infinity in 'mean'"),
    "a pipe in the key-value store": Case(manifest(pipe), "no regular file"),
    "an array of 10^15 numbers": Case(
        first_leaf(lambda leaf: leaf.update(shape=[10**15, 32], chunks=[10**15, 32])), "of the wrong shape"
    ),
    "chunks larger than their array": Case(
        first_leaf(lambda leaf: leaf.update(chunks=[10**9, 10**9])), "its chunks of .* are larger than itself"
    ),
    "a chunk of 3 GB in 90 kB": Case(jax(chunk_of_gigabytes), "cannot be read"),
    "a pipe for a tokenizer": Case(tokenizer(pipe), "no regular file"),
    "a tokenizer of 5 GB": Case(
        tokenizer(lambda path: sparse(path, 5 * 10**9)), "a sentencepiece model of 64000000 at most"
    ),
}
