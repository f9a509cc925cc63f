"""Recognise the format of a checkpoint folder from its files, and describe folders of other kinds."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

from vla_attention.capture.policies.checkpoints import (
    CheckpointNotFound,
    UnsupportedCheckpoint,
    check_checkpoint_file,
    read_json_object,
)
from vla_attention.schemas.errors import listing

CheckpointFormat = Literal["openpi_torch", "openpi_jax", "lerobot"]

#: The weights of both PyTorch formats: one file, or several with an index.
WEIGHTS = "model.safetensors"
WEIGHTS_INDEX = "model.safetensors.index.json"
#: peft's file beside the weights of an adapter.
ADAPTER = "adapter_config.json"
#: How far below a folder checkpoints are looked for: LeRobot's are in RUN/checkpoints/STEP/pretrained_model.
_SEARCH_DEPTH = 3
#: What LeRobot saves beside a policy, and the types of its policies that are read.
PREPROCESSOR, _LEROBOT_TYPES = "policy_preprocessor.json", ("pi0", "pi05")

#: Name of each format in messages, with the files that it consists of.
FORMAT_TITLES: dict[CheckpointFormat, str] = {
    "openpi_torch": "openpi's PyTorch format (model.safetensors)",
    "openpi_jax": "openpi's JAX format (params/_METADATA)",
    "lerobot": "LeRobot's format (config.json with a type, model.safetensors and policy_preprocessor.json)",
}


def detect_format(folder: str | Path, wanted: CheckpointFormat | None = None) -> CheckpointFormat:
    """Return the format of a checkpoint folder; it is `wanted`, if given and its files exist.

    Raises `CheckpointNotFound`, `UnsupportedCheckpoint` (with a description of the folder) or `UnreadableCheckpoint`.
    """
    folder = Path(folder)
    if folder.is_file():
        raise CheckpointNotFound(f"'{folder}' is a file; give the folder that holds it, '{folder.absolute().parent}'.")
    if not folder.is_dir():
        raise CheckpointNotFound(f"There is no checkpoint folder at '{folder}'.")
    if _has(folder / ADAPTER):
        raise UnsupportedCheckpoint(_adapter(folder))
    has_params, has_config = _has(folder / "params" / "_METADATA"), _has(folder / "config.json")
    has_tensors = _has(folder / WEIGHTS) or _has(folder / WEIGHTS_INDEX)
    names = sorted(path.name for path in folder.iterdir())
    if wanted is not None:
        has = {"openpi_jax": has_params, "openpi_torch": has_tensors, "lerobot": has_tensors and has_config}
        if not has[wanted]:
            raise UnsupportedCheckpoint(f"'{folder}' is not in {FORMAT_TITLES[wanted]}: it holds {listing(names)}.")
        return wanted
    if has_params:
        return "openpi_jax"
    family = _stated_family(read_json_object(folder / "config.json")) if has_config else None
    if has_tensors and family in _LEROBOT_TYPES:
        return "lerobot"
    if has_tensors and family is None and (has_config or PREPROCESSOR not in names):
        return "openpi_torch"  # without a config.json: as its training leaves it
    raise UnsupportedCheckpoint(_what_it_is(folder, names, family))


def _has(file: Path) -> bool:
    """Whether a checkpoint has a file; `UnreadableCheckpoint` for a pipe or a link in its place."""
    if not os.path.lexists(file):
        return False
    check_checkpoint_file(file)
    return True


def _stated_family(config: Mapping[str, Any]) -> str | None:
    """The model that a config.json of LeRobot or transformers names."""
    architectures = config.get("architectures")
    named = architectures[0] if isinstance(architectures, list) and architectures else architectures
    family = config.get("type") or config.get("model_type") or named
    return None if family is None else str(family)


def _what_it_is(folder: Path, names: Sequence[str], family: str | None) -> str:
    """Return a sentence: why a folder is no pi checkpoint, and if possible what to give instead."""
    if folder.name == "params" and "_METADATA" in names:
        return f"'{folder}' is the params folder of a checkpoint; give its parent '{folder.parent}'."
    if inner := _checkpoints_in(folder):
        return f"'{folder}' holds checkpoints rather than being one; give one of its folders {listing(inner)}."
    if family in _LEROBOT_TYPES:
        return f"'{folder}' is a LeRobot checkpoint without its {WEIGHTS}: found {listing(names)}."
    if family is None and any("cosmos" in name.casefold() for name in names):
        family = "Cosmos Policy"
    if family is not None:
        return f"'{folder}' is a checkpoint of another model family: {family!r}, not pi0 or pi0.5."
    if PREPROCESSOR in names:
        return f"'{folder}' is a LeRobot checkpoint without its config.json: found {listing(names)}."
    return (
        f"'{folder}' is not a pi checkpoint: expected {FORMAT_TITLES['openpi_torch']}, {FORMAT_TITLES['openpi_jax']} "
        f"or {FORMAT_TITLES['lerobot']}, found {listing(names)}."
    )


def _adapter(folder: Path) -> str:
    """Return a sentence: the folder is an adapter, of what, and how it becomes a policy."""
    base = read_json_object(folder / ADAPTER).get("base_model_name_or_path") or "a policy that it does not name"
    return (
        f"'{folder}' holds an adapter (LoRA) of {base}, not a whole policy: merge it with peft's "
        "PeftModel.from_pretrained(policy, ...).merge_and_unload(), save the policy with save_pretrained, and give "
        "that folder (docs/my-checkpoint.md has the lines)."
    )


def _checkpoints_in(folder: Path) -> list[str]:
    """Return the checkpoints below a folder by their paths in it, the highest numbers first; no unfinished ones."""
    files = {"params/_METADATA": 2, WEIGHTS: 1, WEIGHTS_INDEX: 1}
    found = {
        path.parents[up - 1].relative_to(folder)
        for depth in range(1, _SEARCH_DEPTH + 1)
        for file, up in files.items()
        for path in folder.glob(f"{'*/' * depth}{file}")
    }
    whole = [path for path in found if not any(part.startswith("tmp_") or ".orbax-" in part for part in path.parts)]
    by_number = [
        ([(not part.isdigit(), -int(part) if part.isdigit() else 0, part) for part in p.parts], p) for p in whole
    ]
    return [path.as_posix() for _, path in sorted(by_number)]
