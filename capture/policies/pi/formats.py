"""Recognise the format of a checkpoint folder from its files, and describe folders of other kinds."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any, Literal, get_args

from vla_attention.capture.policies.checkpoints import (
    CheckpointNotFound,
    UnsupportedCheckpoint,
    check_checkpoint_file,
    read_json_object,
)
from vla_attention.schemas.errors import listing

CheckpointFormat = Literal["openpi_torch", "openpi_jax", "lerobot"]
CHECKPOINT_FORMATS: tuple[CheckpointFormat, ...] = get_args(CheckpointFormat)

#: The weights of both PyTorch formats: one file, or several with an index.
WEIGHTS = "model.safetensors"
WEIGHTS_INDEX = "model.safetensors.index.json"
#: peft's file beside the weights of an adapter.
ADAPTER = "adapter_config.json"
#: How far below a folder checkpoints are looked for: LeRobot's are in RUN/checkpoints/STEP/pretrained_model.
_SEARCH_DEPTH = 3

#: Name of each format in messages, with the files that it consists of.
FORMAT_TITLES: dict[CheckpointFormat, str] = {
    "openpi_torch": "openpi's PyTorch format (model.safetensors)",
    "openpi_jax": "openpi's JAX format (params/_METADATA)",
    "lerobot": "LeRobot's format (config.json with a type, model.safetensors and policy_preprocessor.json)",
}

#: Words in the configuration of a transformers checkpoint, and the model that each of them names.
_OTHER_FAMILIES = {
    "openvla": "OpenVLA",
    "gr00t": "GR00T",
    "groot": "GR00T",
    "smolvla": "SmolVLA",
    "smolvlm": "SmolVLM",
    "paligemma": "PaliGemma (the vision-language model alone)",
    "gemma": "Gemma (the language model alone)",
    "siglip": "SigLIP (the image encoder alone)",
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
    has_params = _has(folder / "params" / "_METADATA")
    has_config = _has(folder / "config.json")
    has_tensors = _has(folder / WEIGHTS) or _has(folder / WEIGHTS_INDEX)
    if wanted is not None:
        has = {"openpi_jax": has_params, "openpi_torch": has_tensors, "lerobot": has_tensors and has_config}
        if not has[wanted]:
            content = listing(sorted(path.name for path in folder.iterdir()))
            raise UnsupportedCheckpoint(f"'{folder}' is not in {FORMAT_TITLES[wanted]}: it holds {content}.")
        return wanted
    if has_params:
        return "openpi_jax"
    if has_tensors and has_config:
        return _format_of_config(folder, read_json_object(folder / "config.json"))
    if has_tensors and not _has(folder / "policy_preprocessor.json"):
        return "openpi_torch"  # as its training leaves it
    raise UnsupportedCheckpoint(_what_it_is(folder))


def _has(file: Path) -> bool:
    """Whether a checkpoint has a file; `UnreadableCheckpoint` for a pipe or a link in its place."""
    if not os.path.lexists(file):
        return False
    check_checkpoint_file(file)
    return True


def _format_of_config(folder: Path, config: dict[str, Any]) -> CheckpointFormat:
    kind = config.get("type")
    if kind in ("pi0", "pi05"):
        return "lerobot"
    if kind is not None:
        raise UnsupportedCheckpoint(
            f"'{folder}' is a LeRobot checkpoint of another model family: type '{kind}', not pi0 or pi05."
        )
    family = _transformers_family(config)
    if family is not None:
        raise UnsupportedCheckpoint(f"'{folder}' is a checkpoint of another model family: {family}, not pi0 or pi0.5.")
    return "openpi_torch"


def _transformers_family(config: dict[str, Any]) -> str | None:
    """Name the model of a transformers configuration, or None for a configuration of another kind."""
    if "model_type" not in config and "architectures" not in config:
        return None
    architectures = config.get("architectures")
    named = [config.get("model_type"), *(architectures if isinstance(architectures, list) else [architectures])]
    words = [str(word) for word in named if word]
    for part, family in _OTHER_FAMILIES.items():
        if any(part in word.casefold() for word in words):
            return family
    return f"a transformers model '{words[0] if words else 'without a name'}'"


def _what_it_is(folder: Path) -> str:
    """Return a sentence: why a folder is no pi checkpoint, and if possible what to give instead."""
    names = sorted(path.name for path in folder.iterdir())
    if folder.name == "params" and "_METADATA" in names:
        return f"'{folder}' is the params folder of a checkpoint; give its parent '{folder.parent}'."
    if inner := _checkpoints_in(folder):
        return f"'{folder}' holds checkpoints rather than being one; give one of its folders {listing(inner)}."
    if "config.json" in names:
        config = read_json_object(folder / "config.json")
        if config.get("type") in ("pi0", "pi05"):
            return f"'{folder}' is a LeRobot checkpoint without its {WEIGHTS}: found {listing(names)}."
        family = config.get("type") or _transformers_family(config)
        if family:
            return f"'{folder}' is a checkpoint of another model family: {family}, not pi0 or pi0.5."
    if "policy_preprocessor.json" in names:
        return f"'{folder}' is a LeRobot checkpoint without its config.json: found {listing(names)}."
    if any("cosmos" in name.casefold() for name in names):
        return f"'{folder}' is a checkpoint of another model family: Cosmos Policy, not pi0 or pi0.5."
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
        "that folder (docs/checkpoints.md has the lines)."
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
