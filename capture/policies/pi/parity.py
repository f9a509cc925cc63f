"""Run a parity case, and compare our actions and attention with the reference's."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from vla_attention.capture.policies.parity_case import UnusableCase, json_number, print_results
from vla_attention.capture.policies.pi.case import (
    CHECKPOINT_FOLDERS,
    Case,
    CaseFormat,
    find_case_format,
    read_case,
)
from vla_attention.capture.policies.pi.loading import load_pi_model
from vla_attention.capture.policies.pi.model import PiModel
from vla_attention.capture.policies.weights import dtype_name
from vla_attention.capture.recording.attention import RowCollector
from vla_attention.schemas.errors import BadArgument, listing

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

    tokens = tensor("tokenized_prompt", np.int64)
    if tokens.numel() and not 0 <= int(tokens.min()) <= int(tokens.max()) < case.config.vocab_size:
        raise BadArgument(
            f"The prompt of the case '{case.name}' has token ids outside 0 to {case.config.vocab_size - 1}."
        )
    actions = model.sample_actions(
        images={camera: image(camera) for camera in case.config.cameras},
        image_masks={camera: tensor(f"image_mask_{camera}", np.bool_) for camera in case.config.cameras},
        tokens=tokens,
        token_mask=tensor("tokenized_prompt_mask", np.bool_),
        state=tensor("state", np.float32),
        noise=tensor("noise", np.float32),
        num_steps=int(given["num_steps"]),
        recorder=collector,
    )
    return actions.cpu().numpy()


def measure(case: Case, case_format: CaseFormat, *, limit: float | None = None, device: str = "cpu") -> Parity:
    """Load the case's checkpoint of that format, run it, and compare with the expected results.

    Cases are made by openpi's JAX model, so its time convention is used for every format.
    """
    if limit is not None and not limit > 0:
        raise BadArgument(f"Cannot use a limit of {limit}; expected a positive number.")
    folder, checkpoint_format = case.checkpoint(case_format)
    model, _ = load_pi_model(
        folder, checkpoint_format=checkpoint_format, config=case.config, dtype=case.dtype, device=device
    )
    collector = AllRows(case.expected["attn"])
    actions = run_case(case, model, collector)
    worst = np.abs(actions.astype(np.float64) - case.expected["actions"]).max()
    return Parity(
        case=case.name,
        case_format=case_format,
        limit=LIMITS[case.dtype] if limit is None else limit,
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


def run_parity(
    folder: Path, case_format: str | None, *, limit: float | None = None, as_json: bool = False, device: str = "cpu"
) -> int:
    """Compare a case in one format, or in all of its formats; print the results, return 0 if all pass, else 1."""
    case = read_case(folder)
    formats = case.formats if case_format is None else (find_case_format(case_format),)
    if not formats:
        wanted = listing(name for name, _ in CHECKPOINT_FOLDERS.values())
        raise UnusableCase(f"The case '{folder}' carries no checkpoint: it should have a folder of {wanted}.")
    results = (measure(case, chosen, limit=limit, device=device) for chosen in formats)
    return print_results(results, lambda result: describe(case, result), as_json=as_json)
