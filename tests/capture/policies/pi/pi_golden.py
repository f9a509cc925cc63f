"""Helpers of the pi tests: golden cases that openpi computed, a collector that keeps all rows, made-up observations."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch

from capture.environments.base import Observation
from capture.policies.pi.config import GemmaConfig, PiConfig, SiglipConfig
from capture.policies.pi.model import PiModel

ROOT = Path(__file__).parents[4]
GOLDEN = ROOT / "tests" / "golden" / "pi"
#: larger cases, too large for the repository, where a checkout has them beside it
LARGE_GOLDEN = ROOT.parent / "shared" / "golden" / "pi"


def case_config(case: dict) -> PiConfig:
    """The configuration that a golden case's case.json describes."""
    sizes = case["config"]
    gemma = {
        part: GemmaConfig(**{name: size for name, size in sizes[part].items() if name != "lora_configs"})
        for part in ("paligemma", "action_expert")
    }
    siglip = SiglipConfig(**{name: size for name, size in sizes["siglip"].items() if name != "num_classes"})
    return PiConfig(
        **gemma,
        siglip=siglip,
        vocab_size=sizes["vocab_size"],
        action_dim=sizes["action_dim"],
        action_horizon=sizes["action_horizon"],
        max_token_len=sizes["max_token_len"],
        num_denoise_steps=sizes["num_steps"],
        pi05=case["model"] == "pi05",
    )


class KeepAll:
    """A row collector for parity tests: every layer, denoise step, batch entry, head and suffix query."""

    def __init__(self):
        self.rows = {}

    def sink(self, layer, denoise_step, action_queries):
        def take(rows):
            self.rows[denoise_step, layer] = rows.numpy().copy()

        return take

    def stacked(self) -> np.ndarray:
        """(denoise, layer, batch, head, query, key)."""
        steps, layers = (1 + max(index) for index in zip(*self.rows, strict=True))
        return np.stack([np.stack([self.rows[step, layer] for layer in range(layers)]) for step in range(steps)])


@dataclass
class GoldenCase:
    folder: Path
    config: PiConfig
    inputs: dict[str, np.ndarray]
    expected: dict[str, np.ndarray]
    weights: dict[str, np.ndarray]

    def single(self, entry: int) -> GoldenCase:
        """The same case with one entry of the batch."""
        inputs = {name: x[entry : entry + 1] if x.ndim else x for name, x in self.inputs.items()}
        return replace(self, inputs=inputs)

    def sample(self, model: PiModel, recorder=None) -> np.ndarray:
        """Run the model on the case's inputs."""
        given = self.inputs

        def image(camera):
            return torch.from_numpy(given[f"image_{camera}"].astype(np.float32) / 255 * 2 - 1).permute(0, 3, 1, 2)

        return model.sample_actions(
            images={camera: image(camera) for camera in self.config.cameras},
            image_masks={camera: torch.from_numpy(given[f"image_mask_{camera}"]) for camera in self.config.cameras},
            tokens=torch.from_numpy(given["tokenized_prompt"]),
            token_mask=torch.from_numpy(given["tokenized_prompt_mask"]),
            state=torch.from_numpy(given["state"]),
            noise=torch.from_numpy(given["noise"]),
            num_steps=int(given["num_steps"]),
            recorder=recorder,
        ).numpy()


def load_case(folder: Path) -> GoldenCase:
    case = json.loads((folder / "case.json").read_text())
    arrays = [dict(np.load(folder / f"{name}.npz")) for name in ("inputs", "expected", "weights_flat")]
    return GoldenCase(folder, case_config(case), *arrays)


def make_observation(seed: int) -> Observation:
    generator = np.random.default_rng(seed)

    def picture():
        frame = np.full((256, 256, 3), 150, dtype=np.uint8)
        frame[128:] = (120, 100, 80)
        for _ in range(6):
            row, column = generator.integers(0, 216, 2)
            height, width = generator.integers(15, 40, 2)
            frame[row : row + height, column : column + width] = generator.integers(0, 255, 3)
        return frame

    return Observation(
        images={"agentview": picture(), "robot0_eye_in_hand": picture()},
        eef_pos=np.array([-0.2, 0.05, 1.0]),
        eef_quat=np.array([0.999, 0.02, 0.03, 0.01]),
        gripper_qpos=np.array([0.03, -0.03]),
    )
