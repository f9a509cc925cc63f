"""Parity cases of the pi models: our actions and attention against those of openpi's JAX code."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor

from tests.kit.parity import json_number, read_arrays, read_case_file
from vla_attention.capture.policies.pi.config import PiConfig
from vla_attention.capture.policies.pi.formats import CheckpointFormat
from vla_attention.capture.policies.pi.loading import load_pi_model
from vla_attention.capture.policies.pi.model import PiModel
from vla_attention.capture.policies.pi.stated_sizes import CASE_FILE, read_config
from vla_attention.capture.policies.weights import DTYPES, dtype_name
from vla_attention.capture.recording.attention import RowCollector

CaseFormat = Literal["orbax", "openpi", "lerobot"]

#: For each format of a case: the folder of the checkpoint, and the loader's name of the format.
CHECKPOINT_FOLDERS: dict[CaseFormat, tuple[str, CheckpointFormat]] = {
    "orbax": ("checkpoint", "openpi_jax"),
    "openpi": ("checkpoint_openpi_torch", "openpi_torch"),
    "lerobot": ("checkpoint_lerobot", "lerobot"),
}


@dataclass(frozen=True)
class Case:
    """A case folder: sizes, inputs and expected results.

    inputs: image_<slot> (batch, height, width, 3) uint8, image_mask_<slot> (batch,), state (batch, action dim),
    tokenized_prompt and tokenized_prompt_mask (batch, text), noise (batch, horizon, action dim), num_steps.
    expected: actions (batch, horizon, action dim), attn (denoise, layer, batch, head, query, key), all suffix queries.
    """

    name: str
    folder: Path
    config: PiConfig
    dtype: torch.dtype
    inputs: Mapping[str, np.ndarray]
    expected: Mapping[str, np.ndarray]

    @property
    def formats(self) -> tuple[CaseFormat, ...]:
        """The formats of the case's checkpoints."""
        return tuple(name for name, (folder, _) in CHECKPOINT_FOLDERS.items() if (self.folder / folder).is_dir())


def read_case(folder: Path) -> Case:
    """Read a case folder."""
    content = read_case_file(folder)
    return Case(
        name=str(content.get("name", folder.name)),
        folder=folder,
        config=read_config(folder / CASE_FILE),
        dtype=DTYPES[content.get("compute_dtype", "float32")],
        inputs=read_arrays(folder / "inputs.npz"),
        expected=read_arrays(folder / "expected.npz"),
    )


#: Largest difference of attention and actions that passes, by the precision of the case. In float32 the reference
#: itself moves by 1.6e-5 between its compiled and its eager run; in bfloat16 it moves attention by up to 0.05 from
#: float32.
LIMITS = {torch.float32: 5e-5, torch.bfloat16: 0.1}


@dataclass(frozen=True)
class Parity:
    """The largest differences of one case in one format; attention is (layer, denoise)."""

    case: str
    case_format: CaseFormat
    limit: float
    actions: float
    attention: np.ndarray

    @property
    def passed(self) -> bool:
        """Whether all differences are within the limit; NaN is beyond it."""
        return bool(self.actions <= self.limit and (self.attention <= self.limit).all())

    def as_json(self) -> dict[str, Any]:
        """Return the result as plain JSON values."""
        return {
            "case": self.case,
            "format": self.case_format,
            "limit": self.limit,
            "passed": self.passed,
            "actions_max": json_number(self.actions),
            "attention_max": json_number(self.attention.max()),
            "attention_max_per_layer_and_step": [[json_number(x) for x in layer] for layer in self.attention],
        }


class AllRows(RowCollector):
    """A row collector that compares every row with the expected one and keeps the largest difference."""

    def __init__(self, expected: np.ndarray):
        self._expected = expected
        steps, layers = expected.shape[:2]
        #: (layer, denoise); NaN where no rows came
        self.largest = np.full((layers, steps), np.nan)

    def sink(self, layer: int, denoise_step: int, action_queries: slice) -> Callable[[Tensor], None]:
        """Return the function that takes the rows (batch, head, query, key) of this call."""

        def take(rows: Tensor) -> None:
            difference = np.abs(rows.cpu().numpy().astype(np.float64) - self._expected[denoise_step, layer])
            self.largest[layer, denoise_step] = difference.max()

        return take


def run_case(case: Case, model: PiModel, collector: AllRows | None = None) -> np.ndarray:
    """Return the model's actions (batch, horizon, action dim) on the case's inputs."""
    given, device = case.inputs, model.device

    def tensor(name: str, dtype: type) -> Tensor:
        return torch.from_numpy(given[name].astype(dtype)).to(device)

    def image(camera: str) -> Tensor:
        pixels = given[f"image_{camera}"].astype(np.float32) / 255.0 * 2.0 - 1.0
        return torch.from_numpy(np.ascontiguousarray(pixels.transpose(0, 3, 1, 2))).to(device)

    actions = model.sample_actions(
        images={camera: image(camera) for camera in case.config.cameras},
        image_masks={camera: tensor(f"image_mask_{camera}", np.bool_) for camera in case.config.cameras},
        tokens=tensor("tokenized_prompt", np.int64),
        token_mask=tensor("tokenized_prompt_mask", np.bool_),
        state=tensor("state", np.float32),
        noise=tensor("noise", np.float32),
        num_steps=int(given["num_steps"]),
        recorder=collector,
    )
    return actions.cpu().numpy()


def measure(case: Case, case_format: CaseFormat, *, device: str = "cpu") -> Parity:
    """Load the case's checkpoint of that format, run it, and compare with the expected results.

    Cases are made by openpi's JAX model, so its time convention is used for every format.
    """
    folder, checkpoint_format = CHECKPOINT_FOLDERS[case_format]
    model = load_pi_model(
        case.folder / folder, case.config, checkpoint_format=checkpoint_format, dtype=case.dtype, device=device
    )
    collector = AllRows(case.expected["attn"])
    actions = run_case(case, model, collector)
    worst = np.abs(actions.astype(np.float64) - case.expected["actions"]).max()
    return Parity(
        case=case.name,
        case_format=case_format,
        limit=LIMITS[case.dtype],
        actions=float(worst),
        attention=collector.largest,
    )


def describe(case: Case, result: Parity) -> str:
    """Return the result as text: the largest differences, then attention per layer and denoise step."""
    config = case.config
    layers, steps = result.attention.shape
    verdict = {True: "within the limit", False: "BEYOND THE LIMIT"}
    lines = [
        f"{result.case} ({'pi0.5' if config.pi05 else 'pi0'}, {dtype_name(case.dtype)}, batch "
        f"{len(case.inputs['noise'])}, {layers} layers, {steps} denoise steps), format {result.case_format}, "
        f"limit {result.limit:.1e}",
        f"  actions    {result.actions:.1e}  {verdict[bool(result.actions <= result.limit)]}",
        f"  attention  {result.attention.max():.1e}  {verdict[bool((result.attention <= result.limit).all())]}",
        "  largest difference of attention, by layer and denoise step:",
        "  layer " + "".join(f"{step:>9}" for step in range(steps)) + "      all",
    ]
    lines += [
        f"  {layer:>5} " + "".join(f"{x:9.1e}" for x in row) + f"{row.max():9.1e}"
        for layer, row in enumerate(result.attention)
    ]
    lines.append(
        "    all " + "".join(f"{x:9.1e}" for x in result.attention.max(axis=0)) + f"{result.attention.max():9.1e}"
    )
    return "\n".join(lines)


def run_parity(folder: Path, *, device: str = "cpu") -> Iterator[tuple[Parity, str]]:
    """Compare a case in all of its formats; yield each result, also as text."""
    case = read_case(folder)
    for case_format in case.formats:
        result = measure(case, case_format, device=device)
        yield result, describe(case, result)
