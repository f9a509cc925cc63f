"""Parity cases of Cosmos: the sizes and weights of a case, and the networks that are built from them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from vla_attention.capture.policies.checkpoints import values_of
from vla_attention.capture.policies.cosmos.config import (
    LIBERO_FRAMES,
    CosmosConfig,
    DitConfig,
    FrameConfig,
    SamplerConfig,
    VaeConfig,
)
from vla_attention.capture.policies.cosmos.dit import Dit
from vla_attention.capture.policies.cosmos.dit_weights import build_dit, dit_tensors, infer_dit_config
from vla_attention.capture.policies.cosmos.model import CosmosModel
from vla_attention.capture.policies.cosmos.tensor_files import read_tensors
from vla_attention.capture.policies.cosmos.vae import build_encoder
from vla_attention.capture.policies.parity_case import CASE_FILE, UnusableCase, read_arrays, read_case_file
from vla_attention.schemas.errors import listing

CaseKind = Literal["dit_forward", "policy_sample"]
KINDS: tuple[CaseKind, ...] = ("dit_forward", "policy_sample")

#: Settings that the network here does not vary. A case with other values cannot be run.
_FIXED = {
    "patch_temporal": 1,
    "concat_padding_mask": True,
    "pos_emb_cls": "rope3d",
    "use_adaln_lora": True,
    "extra_per_block_abs_pos_emb": False,
    "rope_enable_fps_modulation": False,
    "timestep_scale": 1.0,
}
_DIT_INPUTS = ("latents", "timesteps", "condition_mask", "padding_mask", "text_embeddings")
_RANGES = ("actions_min", "actions_max", "proprio_min", "proprio_max")
_POLICY_INPUTS = ("primary_image", "wrist_image", "proprio", "text_embedding", *_RANGES)


@dataclass(frozen=True)
class CosmosCase:
    """A case folder: the content of case.json, inputs and expected results."""

    name: str
    folder: Path
    kind: CaseKind
    facts: Mapping[str, Any]
    inputs: Mapping[str, np.ndarray]
    expected: Mapping[str, np.ndarray]

    def fact(self, name: str) -> Any:
        """Return one entry of case.json; `UnusableCase` if it is missing."""
        if name not in self.facts:
            raise UnusableCase(f"'{self.folder / CASE_FILE}' does not state '{name}'.")
        return self.facts[name]

    def file(self, name: str) -> Path:
        """Return the path of a file that case.json names, which is beside it."""
        stated = self.fact(name)
        if not isinstance(stated, str) or Path(stated).name != stated:
            raise UnusableCase(
                f"'{self.folder / CASE_FILE}' has {name} {stated!r}; expected the name of a file beside it."
            )
        return self.folder / stated

    def weights(self) -> tuple[DitConfig, dict[str, Any]]:
        """Return the transformer's sizes and its weights by model name; the sizes are checked against case.json."""
        weights = dit_tensors(read_tensors(self.file("state_dict")))
        stated = self.fact("net_config")
        base = DitConfig(
            patch_size=stated.get("patch_spatial", 2),
            rope_t_extrapolation=stated.get("rope_t_extrapolation_ratio", 1.0),
            rope_h_extrapolation=stated.get("rope_h_extrapolation_ratio", 3.0),
            rope_w_extrapolation=stated.get("rope_w_extrapolation_ratio", 3.0),
        )
        config = infer_dit_config(weights, base)
        for name, of_weights in (
            ("model_channels", config.width),
            ("num_blocks", config.num_blocks),
            ("num_heads", config.num_heads),
            ("in_channels", config.in_channels),
            ("crossattn_emb_channels", config.text_dim),
        ):
            if stated.get(name, of_weights) != of_weights:
                raise UnusableCase(
                    f"'{self.folder / CASE_FILE}' states {name} {stated[name]}, but the weights have {of_weights}."
                )
        return config, weights

    def build_dit(self, device: str) -> Dit:
        """Build the case's transformer in float32."""
        config, weights = self.weights()
        return build_dit(config, weights, device=device)

    def build_model(self, device: str) -> CosmosModel:
        """Build the case's transformer and image encoder in float32."""
        with values_of(self.folder / CASE_FILE):
            return self._build_model(device)

    def _build_model(self, device: str) -> CosmosModel:
        dit_config, weights = self.weights()
        vae = self.fact("vae_config")
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
            frames=self._frames(),
            sampler=SamplerConfig(
                num_steps=self.fact("num_denoising_steps"),
                sigma_max=float(self.fact("sigma_max")),
                sigma_min=float(self.fact("sigma_min")),
                rho=float(self.fact("rho")),
            ),
            image_size=self.fact("image_size"),
            text_length=self.inputs["text_embedding"].shape[1],
            chunk_size=self.fact("chunk_size"),
            action_dim=self.fact("action_dim"),
            proprio_dim=len(self.inputs["proprio"]),
        )
        vae_state = read_tensors(self.file("vae_state_dict"))
        encoder = build_encoder(vae_config, vae_state, device=device)
        return CosmosModel(config, build_dit(dit_config, weights, device=device), encoder)

    def _frames(self) -> FrameConfig:
        """The LIBERO frames; `UnusableCase` if the case has others."""
        frames = FrameConfig()
        stated = (self.fact("state_t"), self.fact("num_conditional_frames"), self.fact("action_latent_idx"))
        ours = (frames.count, frames.num_conditioned, LIBERO_FRAMES.index("action"))
        if stated != ours or self.facts.get("solver", "2ab") != "2ab":
            raise UnusableCase(
                f"The case '{self.name}' has {stated[0]} latent frames, {stated[1]} of them given, actions in frame "
                f"{stated[2]} and the solver {self.facts.get('solver')}; a policy here has {ours[0]}, {ours[1]}, "
                f"{ours[2]} and 2ab."
            )
        return frames


def read_case(folder: str | Path) -> CosmosCase:
    """Read a case folder; `UnusableCase` names the file or array that is missing or does not fit."""
    folder = Path(folder)
    facts = read_case_file(folder)
    kind = facts.get("kind")
    if kind not in KINDS:
        raise UnusableCase(f"'{folder / CASE_FILE}' is of kind '{kind}'; expected {listing(KINDS)}.")
    if facts.get("dtype", "float32") != "float32":
        raise UnusableCase(f"'{folder / CASE_FILE}' says dtype '{facts['dtype']}'; expected float32.")
    stated = facts.get("net_config", {})
    if not isinstance(stated, dict):
        raise UnusableCase(f"'{folder / CASE_FILE}' has the net_config {stated!r}; expected a table of sizes.")
    for name, value in _FIXED.items():
        if stated.get(name, value) != value:
            raise UnusableCase(
                f"'{folder / CASE_FILE}' asks for {name} {stated[name]}; the transformer here has {name} {value}."
            )
    inputs, expected = read_arrays(folder / "inputs.npz"), read_arrays(folder / "expected.npz")
    needed = _DIT_INPUTS if kind == "dit_forward" else _POLICY_INPUTS
    missing = [name for name in needed if name not in inputs]
    if missing:
        raise UnusableCase(f"'{folder / 'inputs.npz'}' has no {listing(missing)}; it has {listing(sorted(inputs))}.")
    return CosmosCase(folder.name, folder, kind, facts, inputs, expected)
