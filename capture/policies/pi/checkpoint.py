"""Read pi0 and pi0.5 checkpoints: recognise the format, work out the sizes, load openpi's PyTorch format strictly.

openpi's PyTorch format is config.json and model.safetensors. Its JAX format is read in `orbax`; LeRobot's is recognised.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, Literal

import torch
from safetensors import SafetensorError, safe_open
from torch import Tensor

from capture.policies.pi.config import GEMMA_VARIANTS, GemmaConfig, PiConfig, SiglipConfig
from capture.policies.pi.jax_weights import from_jax_flat
from capture.policies.pi.model import PiModel
from capture.policies.pi.strict import CheckpointMismatch, Shapes, build_model, check_shapes, expected_shapes
from schemas.errors import UserError, listing

__all__ = [
    "CheckpointMismatch",
    "CheckpointNotFound",
    "UnreadableCheckpoint",
    "UnsupportedCheckpoint",
    "detect_format",
    "from_jax_flat",
    "infer_config",
    "load_openpi_torch",
]

CheckpointFormat = Literal["openpi_torch", "openpi_jax", "lerobot"]

_PALIGEMMA = "paligemma_with_expert.paligemma."
_VISION = _PALIGEMMA + "model.vision_tower.vision_model."
_TABLE = _PALIGEMMA + "model.language_model.embed_tokens.weight"
#: The text table is tied to the language model's output layer, and safetensors keeps one name of tied tensors: this one.
_TIED_TABLE = _PALIGEMMA + "lm_head.weight"
#: The expert's output layer is never used and never trained: random numbers of 250 million parameters.
_JUNK = "paligemma_with_expert.gemma_expert.lm_head.weight"

_OPENPI_TORCH = "openpi's PyTorch format (config.json and model.safetensors)"
_OPENPI_JAX = "openpi's JAX format (params/_METADATA)"
#: Text slots when nothing else is said (openpi's model defaults).
_MAX_TOKEN_LEN = {True: 200, False: 48}


class CheckpointNotFound(UserError, FileNotFoundError):
    """The checkpoint folder does not exist."""


class UnsupportedCheckpoint(UserError, ValueError):
    """The folder is no checkpoint, or one in a format that cannot be read."""


class UnreadableCheckpoint(UserError, ValueError):
    """The folder has the right files, but one of them is damaged."""


def detect_format(folder: str | Path) -> CheckpointFormat:
    """Say in which format a checkpoint folder is; raise `CheckpointNotFound` or `UnsupportedCheckpoint` otherwise."""
    folder = Path(folder)
    if not folder.is_dir():
        raise CheckpointNotFound(f"There is no checkpoint folder at '{folder}'.")
    if (folder / "params" / "_METADATA").is_file():
        return "openpi_jax"
    if (folder / "config.json").is_file() and (folder / "model.safetensors").is_file():
        kind = _read_config_json(folder).get("type")
        if kind is None:
            return "openpi_torch"
        if kind in ("pi0", "pi05"):
            return "lerobot"
        raise UnsupportedCheckpoint(f"'{folder}' is a LeRobot checkpoint of type '{kind}', not of pi0 or pi05.")
    if (folder / "_METADATA").is_file() and folder.name == "params":
        raise UnsupportedCheckpoint(
            f"'{folder}' is the params folder of a checkpoint; give its parent '{folder.parent}'."
        )
    content = listing(sorted(path.name for path in folder.iterdir()))
    raise UnsupportedCheckpoint(
        f"'{folder}' is not a pi checkpoint: expected {_OPENPI_TORCH} or {_OPENPI_JAX}, found {content}."
    )


def load_openpi_torch(
    folder: str | Path,
    *,
    config: PiConfig | None = None,
    dtype: torch.dtype = torch.float32,
    device: str | torch.device = "cpu",
) -> PiModel:
    """Load a checkpoint in openpi's PyTorch format.

    Sizes, and whether it is pi0 or pi0.5, come from the tensors; `config` overrides all of that (some facts are in no
    checkpoint: the number of text slots, denoise steps, whether the prompt carries the state).

    Raises `CheckpointNotFound`, `UnsupportedCheckpoint`, `UnreadableCheckpoint` or `CheckpointMismatch`.
    """
    folder = Path(folder)
    found_format = detect_format(folder)
    if found_format != "openpi_torch":
        spoken = {"openpi_jax": "openpi's JAX (orbax)", "lerobot": "LeRobot's"}[found_format]
        raise UnsupportedCheckpoint(f"'{folder}' is a checkpoint in {spoken} format, not in {_OPENPI_TORCH}.")
    try:
        with safe_open(folder / "model.safetensors", framework="pt") as stored:
            by_model_name = _model_names(set(stored.keys()))
            shapes = {name: tuple(stored.get_slice(raw).get_shape()) for name, raw in by_model_name.items()}
            if config is None:
                config = infer_config(shapes, _read_config_json(folder))
            check_shapes(shapes, expected_shapes(config))

            def read(name: str) -> Tensor:
                return stored.get_tensor(by_model_name[name])

            return build_model(config, by_model_name, read, dtype=dtype, device=device)
    except SafetensorError as error:
        raise UnreadableCheckpoint(
            f"'{folder / 'model.safetensors'}' cannot be read ({error}): the file is damaged or its copy incomplete."
        ) from error


def _read_config_json(folder: Path) -> dict[str, Any]:
    path = folder / "config.json"
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except ValueError as error:
        raise UnreadableCheckpoint(f"'{path}' is not valid JSON ({error}).") from error
    if not isinstance(content, dict):
        raise UnreadableCheckpoint(f"'{path}' should hold a JSON object, but holds a {type(content).__name__}.")
    return content


def _model_names(stored: set[str]) -> dict[str, str]:
    """Return model name -> stored name: the text table by its tied name, the expert's output layer left out."""
    names = {name: name for name in stored if name not in (_JUNK, _TIED_TABLE)}
    if _TIED_TABLE in stored:
        names.setdefault(_TABLE, _TIED_TABLE)
    return names


def infer_config(shapes: Shapes, config_json: dict[str, Any]) -> PiConfig:
    """Work out a configuration from tensor shapes (by model name) and openpi's config.json.

    One key/value head is taken for granted (all pi models), and the image encoder's heads are known for So400m's width
    only. A named Gemma variant whose sizes are not those of the tensors raises `CheckpointMismatch`.
    """
    pi05 = "time_mlp_in.weight" in shapes
    if not pi05 and "state_proj.weight" not in shapes:
        raise CheckpointMismatch(
            "The checkpoint has neither time_mlp_in.weight (pi0.5) nor state_proj.weight (pi0), so it is no pi model."
        )
    for name in ("action_dim", "action_horizon"):
        if not isinstance(config_json.get(name), int):
            raise CheckpointMismatch(
                f"The checkpoint's config.json should state '{name}' as a whole number, but has {config_json.get(name)!r}."
            )
    vlm = _gemma_sizes(shapes, _PALIGEMMA + "model.language_model.")
    expert = _gemma_sizes(shapes, "paligemma_with_expert.gemma_expert.model.")
    for key, inferred in (("paligemma_variant", vlm), ("action_expert_variant", expert)):
        named = GEMMA_VARIANTS.get(str(config_json.get(key)))
        if named is not None and named != inferred:
            raise CheckpointMismatch(
                f"The checkpoint's config.json says {key} '{config_json[key]}' ({named}), but the tensors are those "
                f"of {inferred}."
            )
    return PiConfig(
        paligemma=vlm,
        action_expert=expert,
        siglip=_siglip_sizes(shapes),
        action_horizon=config_json["action_horizon"],
        action_dim=config_json["action_dim"],
        max_token_len=_MAX_TOKEN_LEN[pi05],
        vocab_size=_size(shapes, _TABLE, 0),
        pi05=pi05,
    )


def _size(shapes: Shapes, name: str, axis: int) -> int:
    if name not in shapes or len(shapes[name]) <= axis:
        raise CheckpointMismatch(f"The checkpoint lacks {name}, from which a size of the model would be read.")
    return shapes[name][axis]


def _depth(shapes: Shapes, layers: str) -> int:
    return len({name.removeprefix(layers).split(".")[0] for name in shapes if name.startswith(layers)})


def _gemma_sizes(shapes: Shapes, model: str) -> GemmaConfig:
    first = model + "layers.0."
    head_dim = _size(shapes, first + "self_attn.k_proj.weight", 0)
    return GemmaConfig(
        width=_size(shapes, first + "self_attn.q_proj.weight", 1),
        depth=_depth(shapes, model + "layers."),
        mlp_dim=_size(shapes, first + "mlp.gate_proj.weight", 0),
        num_heads=_size(shapes, first + "self_attn.q_proj.weight", 0) // head_dim,
        num_kv_heads=1,
        head_dim=head_dim,
    )


def _siglip_sizes(shapes: Shapes) -> SiglipConfig:
    patch = _VISION + "embeddings.patch_embedding.weight"
    width, so400m = _size(shapes, patch, 0), SiglipConfig()
    if width != so400m.width:
        raise CheckpointMismatch(
            f"The image encoder is {width} wide; its number of heads is known for width {so400m.width} (So400m) only, "
            "so this checkpoint needs an explicit configuration."
        )
    patch_size = _size(shapes, patch, 2)
    tokens = _size(shapes, _VISION + "embeddings.position_embedding.weight", 0)
    return SiglipConfig(
        width=width,
        depth=_depth(shapes, _VISION + "encoder.layers."),
        mlp_dim=_size(shapes, _VISION + "encoder.layers.0.mlp.fc1.weight", 0),
        num_heads=so400m.num_heads,
        patch_size=patch_size,
        image_size=round(tokens**0.5) * patch_size,
    )
