"""Parity cases of Cosmos Policy: our numbers against the reference's, stage by stage."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
import PIL
import torch
from torch import Tensor

from tests.kit.parity import json_number, read_arrays, read_case_file
from vla_attention.capture.policies.cosmos.config import (
    CosmosConfig,
    DitConfig,
    FrameConfig,
    SamplerConfig,
    VaeConfig,
)
from vla_attention.capture.policies.cosmos.dit import Attention, Dit
from vla_attention.capture.policies.cosmos.dit_weights import build_dit, dit_tensors, infer_dit_config
from vla_attention.capture.policies.cosmos.latents import actions_of_frame, condition_mask
from vla_attention.capture.policies.cosmos.model import CosmosModel
from vla_attention.capture.policies.cosmos.preprocess import Ranges, compressed_picture
from vla_attention.capture.policies.cosmos.sampler import sample, seeded_noise
from vla_attention.capture.policies.cosmos.tensor_files import read_tensors
from vla_attention.capture.policies.cosmos.vae import build_encoder
from vla_attention.capture.recording.attention import RowSink
from vla_attention.capture.recording.contributions import Projection, part_contributions

CaseKind = Literal["dit_forward", "policy_sample"]


@dataclass(frozen=True)
class CosmosCase:
    """A case folder: the content of case.json, inputs and expected results."""

    name: str
    folder: Path
    kind: CaseKind
    facts: Mapping[str, Any]
    inputs: Mapping[str, np.ndarray]
    expected: Mapping[str, np.ndarray]

    def weights(self) -> tuple[DitConfig, dict[str, Any]]:
        """Return the transformer's sizes and its weights by model name."""
        weights = dit_tensors(read_tensors(self.folder / self.facts["state_dict"]))
        stated = self.facts["net_config"]
        base = DitConfig(
            patch_size=stated.get("patch_spatial", 2),
            rope_t_extrapolation=stated.get("rope_t_extrapolation_ratio", 1.0),
            rope_h_extrapolation=stated.get("rope_h_extrapolation_ratio", 3.0),
            rope_w_extrapolation=stated.get("rope_w_extrapolation_ratio", 3.0),
        )
        return infer_dit_config(weights, base), weights

    def build_dit(self, device: str) -> Dit:
        """Build the case's transformer in float32."""
        config, weights = self.weights()
        return build_dit(config, weights, device=device)

    def build_model(self, device: str) -> CosmosModel:
        """Build the case's transformer and image encoder in float32."""
        dit_config, weights = self.weights()
        vae = self.facts["vae_config"]
        vae_config = VaeConfig(
            base_dim=vae["dim"],
            latent_channels=vae["z_dim"],
            dim_mult=tuple(vae["dim_mult"]),
            num_res_blocks=vae["num_res_blocks"],
            temporal_downsample=tuple(vae["temperal_downsample"]),
        )
        config = CosmosConfig(
            dit=dit_config,
            vae=vae_config,
            frames=FrameConfig(),
            sampler=SamplerConfig(
                num_steps=self.facts["num_denoising_steps"],
                sigma_max=float(self.facts["sigma_max"]),
                sigma_min=float(self.facts["sigma_min"]),
                rho=float(self.facts["rho"]),
            ),
            image_size=self.facts["image_size"],
            text_length=self.inputs["text_embedding"].shape[1],
            chunk_size=self.facts["chunk_size"],
            action_dim=self.facts["action_dim"],
            proprio_dim=len(self.inputs["proprio"]),
        )
        vae_state = read_tensors(self.folder / self.facts["vae_state_dict"])
        encoder = build_encoder(vae_config, vae_state, device=device)
        return CosmosModel(config, build_dit(dit_config, weights, device=device), encoder)


def read_case(folder: Path) -> CosmosCase:
    """Read a case folder."""
    facts = read_case_file(folder)
    inputs, expected = read_arrays(folder / "inputs.npz"), read_arrays(folder / "expected.npz")
    return CosmosCase(folder.name, folder, facts["kind"], facts, inputs, expected)


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
        assert numbers.shape == wanted.shape, (stage, numbers.shape, wanted.shape)
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
class CallTrace:
    """Inputs and outputs of each network evaluation."""

    noisy: list[Tensor] = field(default_factory=list)
    net_input: list[Tensor] = field(default_factory=list)
    times: list[Tensor] = field(default_factory=list)
    net_output: list[Tensor] = field(default_factory=list)
    clean: list[Tensor] = field(default_factory=list)

    def network(self, dit: Dit, inputs: tuple[Tensor, ...], output: Tensor) -> None:
        """Keep what the network gets and gives; a forward hook."""
        self.net_input.append(inputs[0])
        self.times.append(inputs[1].to(dit.dtype).float())
        self.net_output.append(output.float())


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


def run_case(folder: Path, *, device: str = "cpu") -> ParityReport:
    """Run a case of either kind."""
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

    pictures = [compressed_picture(inputs[name], config.image_size) for name in ("wrist_image", "primary_image")]
    compare("preprocessed_images", np.stack(pictures), PICTURES)
    if case.facts.get("pillow") != PIL.__version__ and "preprocessed_images" in expected:
        pictures = list(expected["preprocessed_images"])  # so that later stages do not depend on the JPEG decoder
    statistics = Ranges(**{name: inputs[name].tolist() for name in Ranges.__struct_fields__})
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
    actions = actions_of_frame(action_frame, config.chunk_size, config.action_dim).cpu().numpy()
    compare("actions_normalized", actions, ACTIONS)
    compare("actions", statistics.environment_actions(actions), ACTIONS)
    value = (latents[0, :, config.frames.index("value")].mean() + 1) / 2
    compare("value", np.asarray(float(value.clamp(0, 1))), ACTIONS)
    return report


def _sample(
    case: CosmosCase, model: CosmosModel, given: Tensor, trace: CallTrace, observers: list[EverythingObserver]
) -> Tensor:
    """Sample as the model does, with an observer that keeps all rows if the case has them."""
    noise = torch.from_numpy(seeded_noise(case.facts["sampler_seed"], model.config.latent_shape)).to(model.device)
    mask = condition_mask(model.config).to(model.device)
    text = torch.from_numpy(case.inputs["text_embedding"]).to(model.device)
    has_rows = any(name.endswith("_action_rows") for name in case.expected)

    def denoise(noisy: Tensor, sigma: float, step: int) -> Tensor:
        observer = observers[step] if has_rows else None
        trace.noisy.append(noisy)
        trace.clean.append(model.denoise(noisy, sigma, given, mask, text, observer))
        return trace.clean[-1]

    hook = model.dit.register_forward_hook(trace.network)
    try:
        return sample(denoise, noise, model.levels)
    finally:
        hook.remove()


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


def run_parity(folder: Path, *, device: str = "cpu") -> Iterator[tuple[ParityReport, str]]:
    """Run a case; yield its report, also as text."""
    report = run_case(folder, device=device)
    yield report, describe(report)
