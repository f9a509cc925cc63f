"""A folder of made-up demonstrations in the format of `examples.cubes_policy demonstrate`: coloured dots, no simulator.

The action points from the gripper to the named dot, so that a policy can learn something from few samples.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

INSTRUCTIONS = (
    "touch the red cube",
    "lift the green cube",
    "push the blue cube to the left",
    "push the red cube to the right",
    "put the red cube on the green cube",
)
_TARGETS, _DESTINATIONS = (0, 1, 2, 0, 0), (-1, -1, -1, -1, 1)
_RGB = np.array([(220, 30, 30), (30, 170, 40), (30, 60, 220), (230, 210, 40)], dtype=np.uint8)


def write_demonstrations(folder: Path, *, scenes: int = 12, steps: int = 8, parts: int = 2, seed: int = 0) -> Path:
    """Write `scenes` x 5 tasks x `steps` samples in `parts` files; returns the folder."""
    rng = np.random.default_rng(seed)
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "demonstrations.json").write_text(json.dumps({"made_up": True, "seed": seed}))
    for part, chosen in enumerate(np.array_split(np.arange(scenes), parts)):
        samples = [_sample(rng, scene, task, step) for scene in chosen for task in range(5) for step in range(steps)]
        arrays = {name: np.stack([sample[name] for sample in samples]) for name in samples[0]}
        np.savez_compressed(folder / f"part_{part:04d}.npz", **arrays)
    return folder


def _sample(rng: np.random.Generator, scene: int, task: int, step: int) -> dict[str, np.ndarray]:
    places = np.random.default_rng([int(scene), 7]).permutation(
        [(0.25, 0.25), (0.25, 0.75), (0.75, 0.25), (0.75, 0.75)]
    )
    eef = rng.uniform(0.0, 1.0, 2)
    pictures = np.full((2, 64, 64, 3), 120, dtype=np.uint8)
    for colour, (row, column) in enumerate(places):
        top, left = int(row * 64) - 4, int(column * 64) - 4
        pictures[:, top : top + 8, left : left + 8] = _RGB[colour]
    positions = np.column_stack([places, np.zeros(4)]).astype(np.float32)
    if scene % 2:
        positions[3] = np.nan
    towards = np.concatenate([places[_TARGETS[task]] - eef, [0.0], np.zeros(3), [1.0 if task else -1.0]])
    state = np.concatenate([eef, rng.normal(size=6)])
    return {
        "pictures": pictures,
        "state": state.astype(np.float32),
        "actions": np.tile(towards.clip(-1, 1), (10, 1)).astype(np.float32),
        "task": np.int16(task),
        "episode": np.int32(scene * 5 + task),
        "step": np.int16(step),
        "eef": np.array([*eef, 0.0], dtype=np.float32),
        "cube_positions": positions,
        "cube_pixels": np.where(np.isnan(positions[None, :, :1]), np.nan, np.stack([places] * 2)).astype(np.float32),
        "target": np.int8(_TARGETS[task]),
        "destination": np.int8(_DESTINATIONS[task]),
        "scene": np.int32(scene),
    }
