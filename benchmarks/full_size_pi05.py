"""Time and peak memory of loading and running a full-size pi0.5 without a GPU, per checkpoint format.

Usage: python benchmarks/full_size_pi05.py [--dtype bfloat16 float32] [--formats openpi_jax openpi_torch lerobot]
           [--folder PATH]

Writes a checkpoint of 3.35 billion random numbers, array by array, with the names and shapes of the released models.
Loads it in a process of its own, runs one replan with recording, and prints wall time and peak resident memory. Each
checkpoint (6.7 or 13.4 GB; for LeRobot one embedding table more) is deleted before the next is written. A checkpoint
runs in the precision that it is stored in.
"""

from __future__ import annotations

import argparse
import gzip
import json
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT))

from benchmarks.measurement import peak_memory  # noqa: E402 - a script, and not part of the package
from benchmarks.orbax_writer import write_orbax  # noqa: E402

GOLDEN = ROOT / "tests" / "golden" / "pi"
MANIFESTS = {
    "openpi_jax": "openpi_jax_pi05_libero",
    "openpi_torch": "openpi_torch_pi05_libero",
    "lerobot": "lerobot_pi05",
}
STATS = "assets/physical-intelligence/libero/norm_stats.json"


def random_source(seed: int = 0, block: int = 1 << 24) -> Callable[[int], np.ndarray]:
    """Return a function that gives n float32 numbers of a normal distribution, cut from one block at random places."""
    generator = np.random.default_rng(seed)
    numbers = generator.standard_normal(block, dtype=np.float32) * np.float32(0.02)
    twice = np.concatenate([numbers, numbers])

    def take(count: int) -> np.ndarray:
        start = int(generator.integers(block))
        return twice[start : start + count] if count <= block else np.resize(twice[start : start + block], count)

    return take


def manifest(checkpoint_format: str) -> dict[str, tuple[int, ...]]:
    content = gzip.decompress((GOLDEN / "key_manifests" / f"{MANIFESTS[checkpoint_format]}.json.gz").read_bytes())
    return {name: tuple(shape) for name, (shape, _) in json.loads(content).items()}


def write_safetensors(path: Path, shapes: dict[str, tuple[int, ...]], dtype: str) -> None:
    """Write a safetensors file tensor by tensor: the header first, then the numbers in its order."""
    width = {"bfloat16": 2, "float32": 4}[dtype]
    header, offset = {}, 0
    for name, shape in shapes.items():
        size = int(np.prod(shape)) * width
        header[name] = {
            "dtype": {2: "BF16", 4: "F32"}[width],
            "shape": list(shape),
            "data_offsets": [offset, offset + size],
        }
        offset += size
    text = json.dumps(header).encode()
    text += b" " * (-len(text) % 8)
    take = random_source()
    with path.open("wb") as file:
        file.write(len(text).to_bytes(8, "little") + text)
        for shape in shapes.values():
            left = int(np.prod(shape))
            while left:
                piece = torch.from_numpy(take(min(left, 1 << 24)))
                left -= len(piece)
                stored = piece.bfloat16() if width == 2 else piece
                file.write(stored.view(torch.uint8).numpy().tobytes())


def write_checkpoint(folder: Path, checkpoint_format: str, dtype: str) -> None:
    """Write a whole checkpoint folder: weights, configuration and statistics."""
    folder.mkdir(parents=True)
    shapes = manifest(checkpoint_format)
    if checkpoint_format == "openpi_jax":
        take = random_source()
        write_orbax(
            folder / "params",
            shapes,
            lambda path, _: take(int(np.prod(shapes[path][1:]))).reshape(shapes[path][1:]),
            dtype=dtype,
        )
    else:
        write_safetensors(folder / "model.safetensors", shapes, dtype)
    if checkpoint_format == "lerobot":
        small = GOLDEN / "pi05_batch2" / "checkpoint_lerobot"
        for file in small.glob("policy_*"):
            text = file.read_bytes()
            (folder / file.name).write_bytes(
                text.replace(b'"max_length": 24', b'"max_length": 200') if file.suffix == ".json" else text
            )
        config = json.loads((small / "config.json").read_text())
        config |= {"image_resolution": [224, 224], "chunk_size": 50, "n_action_steps": 10, "tokenizer_max_length": 200}
        (folder / "config.json").write_text(json.dumps(config | {"dtype": dtype}))
        return
    (folder / STATS).parent.mkdir(parents=True)
    shutil.copy(GOLDEN / "pi0_batch2" / "checkpoint" / STATS, folder / STATS)
    if checkpoint_format == "openpi_torch":
        variants = {"paligemma_variant": "gemma_2b", "action_expert_variant": "gemma_300m"}
        config = {"action_dim": 32, "action_horizon": 10, "precision": dtype, **variants}
        (folder / "config.json").write_text(json.dumps(config))


def load_and_run(folder: Path, checkpoint_format: str, dtype: str) -> dict[str, float]:
    """Load the policy and run one replan with the default recording; seconds, and peak resident memory in GB."""
    from benchmarks.full_size_tokenizer import FullSizeTokenizer
    from vla_attention.capture.environments.base import Observation
    from vla_attention.capture.policies.pi import loading
    from vla_attention.capture.policies.sentencepiece_model import EMBEDDED_TOKENIZER
    from vla_attention.capture.recording.recorder import AttentionRecorder, RecordingPlan

    loading.PromptTokenizer = FullSizeTokenizer  # type: ignore[misc]
    begun = time.perf_counter()
    settings = loading.PiSettings(
        str(folder),
        tokenizer=str(EMBEDDED_TOKENIZER),
        checkpoint_format=checkpoint_format,  # type: ignore[arg-type]
        dtype=dtype,  # type: ignore[arg-type]
    )
    policy = loading.load_pi_policy(settings)
    loaded, peak_loading = time.perf_counter() - begun, peak_memory() / 1e9
    frame = np.random.default_rng(0).integers(0, 255, (256, 256, 3), dtype=np.uint8)
    observation = Observation(
        images={"agentview": frame, "robot0_eye_in_hand": frame},
        eef_pos=np.array([-0.2, 0.05, 1.0]),
        eef_quat=np.array([1.0, 0, 0, 0]),
        gripper_qpos=np.array([0.03, -0.03]),
    )
    given = policy.prepare(observation, "put the black bowl on the plate")
    plan = RecordingPlan(tuple(range(18)), (0, 9), tuple(range(8)), "mean", "joint")
    recorder = AttentionRecorder(plan, policy.sites[0].num_keys)
    begun = time.perf_counter()
    actions = policy.act(given, 0, {"joint": recorder})
    replan = time.perf_counter() - begun
    assert np.isfinite(actions).all()
    assert np.allclose(recorder.finish().row_sum, 1, atol=1e-3)
    weights = sum(tensor.numel() * tensor.element_size() for tensor in policy.model.state_dict().values())
    return {
        "load_s": loaded,
        "replan_s": replan,
        "model_gb": weights / 1e9,
        "peak_load_gb": peak_loading,
        "peak_gb": peak_memory() / 1e9,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--dtype", nargs="+", default=["bfloat16", "float32"], choices=["bfloat16", "float32"])
    parser.add_argument("--formats", nargs="+", default=list(MANIFESTS), choices=list(MANIFESTS))
    parser.add_argument("--folder", type=Path, help="where the checkpoint is written (default: the temporary folder)")
    parser.add_argument("--measure", nargs=3, metavar=("FOLDER", "FORMAT", "DTYPE"), help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.measure:
        folder, checkpoint_format, dtype = arguments.measure
        print(json.dumps(load_and_run(Path(folder), checkpoint_format, dtype)))
        return
    print(f"{torch.get_num_threads()} threads, torch {torch.__version__}")
    titles = f"{'write s':>8} {'load s':>7} {'replan s':>9} {'model GB':>9} {'peak load GB':>13} {'peak GB':>8}"
    print(f"{'format':13} {'dtype':9} {titles}")
    for dtype in arguments.dtype:
        for checkpoint_format in arguments.formats:
            with tempfile.TemporaryDirectory(dir=arguments.folder) as place:
                folder, begun = Path(place) / "checkpoint", time.perf_counter()
                write_checkpoint(folder, checkpoint_format, dtype)
                written = time.perf_counter() - begun
                command = [sys.executable, __file__, "--measure", str(folder), checkpoint_format, dtype]
                done = subprocess.run(command, capture_output=True, text=True, check=False)
            if done.returncode:
                print(f"{checkpoint_format:13} {dtype:9} failed with code {done.returncode}\n{done.stderr[-2000:]}")
                continue
            found = json.loads(done.stdout.splitlines()[-1])
            print(
                f"{checkpoint_format:13} {dtype:9} {written:8.0f} {found['load_s']:7.1f} {found['replan_s']:9.1f} "
                f"{found['model_gb']:9.1f} {found['peak_load_gb']:13.1f} {found['peak_gb']:8.1f}",
                flush=True,
            )


if __name__ == "__main__":
    main()
