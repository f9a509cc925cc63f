"""Run a Cosmos parity case, and compare our numbers with the reference's stage by stage."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import PIL
import torch
from torch import Tensor

from vla_attention.capture.policies.cosmos.case import CosmosCase, read_case
from vla_attention.capture.policies.cosmos.dit import Attention
from vla_attention.capture.policies.cosmos.latents import condition_mask, read_actions, read_value
from vla_attention.capture.policies.cosmos.model import CallTrace, CosmosModel
from vla_attention.capture.policies.cosmos.preprocess import make_statistics, model_picture
from vla_attention.capture.policies.cosmos.sampler import sample, seeded_noise
from vla_attention.capture.policies.parity_case import UnusableCase, json_number, print_results
from vla_attention.capture.recording.attention import RowSink
from vla_attention.capture.recording.contributions import Projection, part_contributions


@dataclass(frozen=True)
class Tolerance:
    """The largest difference that passes: atol + rtol · |expected|."""

    rtol: float
    atol: float


OUTPUTS = Tolerance(rtol=1e-4, atol=2e-5)
PROBABILITIES = Tolerance(rtol=0.0, atol=1e-5)
ACTIONS = Tolerance(rtol=0.0, atol=1e-5)
#: The absolute part is for contributions near 0, for which a relative bound would be below rounding.
NORMS = Tolerance(rtol=1e-5, atol=1e-6)
#: Grey levels: other versions of Pillow decode JPEG a little differently.
PICTURES = Tolerance(rtol=0.0, atol=2.0)
EXACT = Tolerance(rtol=0.0, atol=0.0)


@dataclass(frozen=True)
class StageDifference:
    """One stage: the largest difference, and its largest share of the tolerance. Above 1, or NaN, does not pass."""

    stage: str
    largest: float
    share: float
    tolerance: Tolerance

    @property
    def passed(self) -> bool:
        """Whether every number is within the tolerance."""
        return bool(self.share <= 1.0)


@dataclass
class ParityReport:
    """The stages of a case, in the order in which they are computed."""

    case: str
    kind: str
    stages: list[StageDifference] = field(default_factory=list)

    @property
    def passed(self) -> bool:
        """Whether every stage passed, and there was one."""
        return bool(self.stages) and all(stage.passed for stage in self.stages)

    @property
    def begins(self) -> str | None:
        """The first stage beyond its tolerance."""
        return next((stage.stage for stage in self.stages if not stage.passed), None)

    def compare(self, stage: str, ours: np.ndarray | Tensor, expected: np.ndarray, tolerance: Tolerance) -> None:
        """Compare one stage and add it to the report."""
        numbers = np.asarray(ours.detach().cpu().numpy() if isinstance(ours, Tensor) else ours, dtype=np.float64)
        wanted = np.asarray(expected, dtype=np.float64)
        if numbers.shape != wanted.shape:
            raise UnusableCase(
                f"'{stage}' of the case '{self.case}' has shape {wanted.shape}, but ours has {numbers.shape}."
            )
        difference = np.abs(numbers - wanted)
        allowed = tolerance.atol + tolerance.rtol * np.abs(wanted)
        with np.errstate(divide="ignore", invalid="ignore"):
            shares = np.where(difference == 0, 0.0, difference / allowed)
        self.stages.append(StageDifference(stage, float(difference.max()), float(shares.max()), tolerance))

    def as_json(self) -> dict[str, Any]:
        """Return the report as plain JSON values, with null for NaN and infinity."""

        return {
            "case": self.case,
            "kind": self.kind,
            "passed": self.passed,
            "begins": self.begins,
            "stages": [
                {
                    "stage": stage.stage,
                    "largest": json_number(stage.largest),
                    "share_of_allowed": json_number(stage.share),
                    "rtol": stage.tolerance.rtol,
                    "atol": stage.tolerance.atol,
                    "passed": stage.passed,
                }
                for stage in self.stages
            ],
        }


@dataclass
class EverythingObserver:
    """Keeps the rows of all queries, and the norms of updates and of each frame's contribution, for all blocks.

    For the small sizes of cases only: it keeps token x token arrays.
    """

    _rows: dict[tuple[str, int], list[Tensor]] = field(default_factory=dict)
    _contributions: dict[int, list[Tensor]] = field(default_factory=dict)
    residual_norms: dict[int, Tensor] = field(default_factory=dict)
    contribution_norms: dict[int, Tensor] = field(default_factory=dict)

    def begin_block(self, layer: int) -> None:
        """Nothing is kept of a block's begin."""

    def rows(self, site: str, layer: int, frame: int, attention: Attention, value: Tensor) -> RowSink:
        """Return the function that takes the rows of these queries."""

        def take(rows: Tensor) -> None:
            self._rows.setdefault((site, layer), []).append(rows)
            if site == "self":
                tokens = rows.shape[2]
                spans = [slice(start, start + tokens) for start in range(0, rows.shape[3], tokens)]
                weight = attention.output_proj.weight
                ungated = Projection(weight, None)  # the block's own gate is applied in `updates`
                parts = torch.stack([part_contributions(rows[b], value[b], spans, ungated) for b in range(len(rows))])
                self._contributions.setdefault(layer, []).append(parts)

        return take

    def takes_updates(self, layer: int) -> bool:
        """Return True: updates of every block."""
        return True

    def updates(self, layer: int, updates: dict[str, Tensor], gates: dict[str, Tensor], block_input: Tensor) -> None:
        """Keep the norms (batch, token, 4) of updates and input, and (batch, token, frame + 1) of contributions."""
        norms = [tensor.norm(dim=-1).flatten(1) for tensor in (*updates.values(), block_input)]
        self.residual_norms[layer] = torch.stack(norms, dim=-1)
        frames = torch.stack(self._contributions.pop(layer), dim=1)  # batch, frame of query, query, span, width
        gated = (frames * gates["self"].unsqueeze(3)).norm(dim=-1).flatten(1, 2)
        self.contribution_norms[layer] = torch.cat([gated, norms[1][..., None]], dim=-1)

    def probabilities(self, site: str, layer: int) -> Tensor:
        """Return (batch, head, query, key) of all queries."""
        return torch.cat(self._rows[site, layer], dim=2)

    def frame_rows(self, site: str, frame: int) -> Tensor:
        """Return (block, batch, head, query of the frame, key)."""
        layers = sorted(layer for name, layer in self._rows if name == site)
        return torch.stack([self._rows[site, layer][frame] for layer in layers])


def run_case(folder: str | Path, *, device: str = "cpu") -> ParityReport:
    """Run a case of either kind; `UnusableCase` if it cannot be run."""
    case = read_case(folder)
    with torch.no_grad():
        return _run_forward(case, device) if case.kind == "dit_forward" else _run_policy(case, device)


def _run_forward(case: CosmosCase, device: str) -> ParityReport:
    report = ParityReport(case.name, case.kind)
    dit, observer = case.build_dit(device), EverythingObserver()

    def tensor(name: str) -> Tensor:
        return torch.from_numpy(case.inputs[name]).to(device)

    output = dit(
        tensor("latents"),
        tensor("timesteps"),
        tensor("condition_mask"),
        tensor("padding_mask"),
        tensor("text_embeddings"),
        observer,
    )
    for layer in range(dit.config.num_blocks):
        stages: dict[str, tuple[Tensor, Tolerance]] = {
            "self_attn_probs": (observer.probabilities("self", layer), PROBABILITIES),
            "frame_contrib_norms": (observer.contribution_norms[layer], NORMS),
            "cross_attn_probs": (observer.probabilities("cross", layer), PROBABILITIES),
            "residual_norms": (observer.residual_norms[layer], NORMS),
        }
        for name, (ours, tolerance) in stages.items():
            if (stage := f"{name}_{layer:02d}") in case.expected:
                report.compare(stage, ours, case.expected[stage], tolerance)
    report.compare("output", output, case.expected["output"], OUTPUTS)
    return report


def _run_policy(case: CosmosCase, device: str) -> ParityReport:
    report = ParityReport(case.name, case.kind)
    model = case.build_model(device)
    config, inputs, expected = model.config, case.inputs, case.expected

    def compare(stage: str, ours: np.ndarray | Tensor, tolerance: Tolerance, frames: slice | None = None) -> None:
        """Compare a stage that the case has, or only some of its latent frames."""
        if stage in expected:
            wanted = expected[stage] if frames is None else expected[stage][:, :, frames]
            report.compare(stage, ours, wanted, tolerance)

    pictures = [model_picture(inputs[name], config.image_size) for name in ("wrist_image", "primary_image")]
    compare("preprocessed_images", np.stack(pictures), PICTURES)
    if case.facts.get("pillow") != PIL.__version__ and "preprocessed_images" in expected:
        pictures = list(expected["preprocessed_images"])  # so that later stages do not depend on the JPEG decoder
    statistics = make_statistics(inputs, f"of the case '{case.name}'", config.action_dim, config.proprio_dim)
    proprio = statistics.normalise_proprio(inputs["proprio"])
    compare("proprio_normalized", proprio, OUTPUTS)
    given, count = model.given_latents(pictures, proprio), config.frames.num_conditioned
    compare("vae_latents", given[:, :, 2:count], OUTPUTS, slice(2, count))
    compare("conditioning_latents", given[:, :, :count], OUTPUTS, slice(0, count))
    compare("condition_mask", condition_mask(config), EXACT)
    compare("sigmas", model.levels, OUTPUTS)

    trace, observers = CallTrace(), [EverythingObserver() for _ in model.levels]
    latents = _sample(case, model, given, trace, observers)
    compare("initial_noise_sigma_max", trace.noisy[0], OUTPUTS)
    compare("net_timesteps", torch.stack(trace.times), OUTPUTS)
    for call in range(len(model.levels)):
        _compare_call(report, case, config.frames.index("action"), call, trace, observers[call])
    compare("final_latent", latents, OUTPUTS)
    action_frame = latents[0, :, config.frames.index("action")]
    actions = read_actions(action_frame, config.chunk_size, config.action_dim).cpu().numpy()
    compare("actions_normalized", actions, ACTIONS)
    compare("actions", statistics.environment_actions(actions), ACTIONS)
    compare("value", np.asarray(read_value(latents[0, :, config.frames.index("value")])), ACTIONS)
    return report


def _sample(
    case: CosmosCase, model: CosmosModel, given: Tensor, trace: CallTrace, observers: list[EverythingObserver]
) -> Tensor:
    """Sample as the model does, with an observer that keeps all rows if the case has them."""
    noise = torch.from_numpy(seeded_noise(case.fact("sampler_seed"), model.config.latent_shape)).to(model.device)
    mask = condition_mask(model.config).to(model.device)
    text = torch.from_numpy(case.inputs["text_embedding"]).to(model.device)
    has_rows = any(name.endswith("_action_rows") for name in case.expected)

    def denoise(noisy: Tensor, sigma: float, step: int) -> Tensor:
        observer = observers[step] if has_rows else None
        return model.denoise(noisy, sigma, given, mask, text, observer, trace)

    return sample(denoise, noise, model.levels)


def _compare_call(
    report: ParityReport, case: CosmosCase, action_frame: int, call: int, trace: CallTrace, observer: EverythingObserver
) -> None:
    expected = case.expected

    def compare(name: str, ours: Tensor, tolerance: Tolerance) -> None:
        if name in expected:
            report.compare(f"call {call}: {name}", ours, expected[name][call], tolerance)

    compare("xt", trace.noisy[call], OUTPUTS)
    compare("net_input", trace.net_input[call], OUTPUTS)
    if observer.residual_norms:
        compare("self_attn_action_rows", observer.frame_rows("self", action_frame), PROBABILITIES)
        compare("cross_attn_action_rows", observer.frame_rows("cross", action_frame), PROBABILITIES)
        compare("residual_norms", torch.stack(list(observer.residual_norms.values())), NORMS)
    compare("net_output", trace.net_output[call], OUTPUTS)
    compare("x0", trace.clean[call], OUTPUTS)


def describe(report: ParityReport) -> str:
    """Return the report as text: one line per stage, and the first stage beyond its tolerance."""
    begins = report.begins
    verdict = "within the limits" if report.passed else f"BEYOND THE LIMITS, first at '{begins}'"
    lines = [f"{report.case} ({report.kind}): {verdict}", "  largest     of allowed  stage"]
    lines += [
        f"  {stage.largest:<10.1e}  {stage.share:<10.3f}  {stage.stage}{'' if stage.passed else '   <-- beyond'}"
        for stage in report.stages
    ]
    return "\n".join(lines)


def run_parity(folder: str | Path, *, as_json: bool = False, device: str = "cpu") -> int:
    """Run a case, print its report and return 0 when every stage is within its tolerance, else 1."""
    return print_results([run_case(folder, device=device)], describe, as_json=as_json)
