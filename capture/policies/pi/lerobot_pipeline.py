"""LeRobot's saved pre- and postprocessing: policy_preprocessor.json, policy_postprocessor.json and their state files.

Steps are found by their registered names, because their numbers differ between versions and between pi0 and pi0.5. An
unknown step is an error with its name: it could change the inputs or actions of the policy.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vla_attention.capture.policies.checkpoints import (
    UnreadableCheckpoint,
    UnsupportedCheckpoint,
    read_json_object,
    values_of,
)
from vla_attention.capture.policies.pi.lerobot_config import (
    ACTION_FEATURE,
    STATE_FEATURE,
    LerobotConfig,
    UnsupportedLerobotFeature,
    texts_by_name,
)
from vla_attention.capture.policies.safetensors_file import SafetensorsFile, open_safetensors
from vla_attention.schemas.errors import listing

PREPROCESSOR, POSTPROCESSOR = "policy_preprocessor.json", "policy_postprocessor.json"

_RENAME, _NORMALIZE, _UNNORMALIZE = "rename_observations_processor", "normalizer_processor", "unnormalizer_processor"
_NEW_LINE, _STATE_PROMPT = "pi0_new_line_processor", "pi05_prepare_state_tokenizer_processor_step"
_TOKENIZE, _RELATIVE, _ABSOLUTE = "tokenizer_processor", "relative_actions_processor", "absolute_actions_processor"
#: Steps without effect here: batching, moving to a device.
_NOTHING = {"to_batch_processor", "device_processor"}
_BEFORE = _NOTHING | {_RENAME, _NORMALIZE, _NEW_LINE, _STATE_PROMPT, _TOKENIZE, _RELATIVE}
_AFTER = _NOTHING | {_UNNORMALIZE, _ABSOLUTE}

#: Statistics of each mode of normalisation.
_NEEDED = {"IDENTITY": (), "MEAN_STD": ("mean", "std"), "QUANTILES": ("q01", "q99")}


@dataclass(frozen=True)
class LerobotNormaliser:
    """Normalisation of one vector as LeRobot computes it, in float32.

    mode: IDENTITY, MEAN_STD ((x - mean)/(std + eps), inverse x·std + mean) or QUANTILES (2(x - q01)/(q99 - q01) - 1,
    where a range of 0 counts as eps). statistics: each (dim,) float32.
    """

    mode: str
    statistics: Mapping[str, NDArray[np.float32]]
    eps: float

    def normalise(self, x: NDArray[np.floating]) -> NDArray[np.float32]:
        """Map (..., dim) to the model's range, without clipping."""
        x = np.asarray(x, dtype=np.float32)
        if self.mode == "IDENTITY":
            return x
        if self.mode == "MEAN_STD":
            return (x - self.statistics["mean"]) / (self.statistics["std"] + np.float32(self.eps))
        return np.float32(2.0) * (x - self.statistics["q01"]) / self._range() - np.float32(1.0)

    def unnormalise(self, x: NDArray[np.floating]) -> NDArray[np.float32]:
        """Invert `normalise` on (..., dim)."""
        x = np.asarray(x, dtype=np.float32)
        if self.mode == "IDENTITY":
            return x
        if self.mode == "MEAN_STD":
            return x * self.statistics["std"] + self.statistics["mean"]
        return (x + np.float32(1.0)) * self._range() / np.float32(2.0) + self.statistics["q01"]

    def _range(self) -> NDArray[np.float32]:
        span = self.statistics["q99"] - self.statistics["q01"]
        return np.where(span == 0, np.float32(self.eps), span)


@dataclass(frozen=True)
class LerobotPipeline:
    """Content of the two saved pipelines: camera names, prompt format, normalisation of state and action."""

    rename: dict[str, str]
    state_in_prompt: bool
    new_line: bool
    cut_long_prompts: bool
    state: LerobotNormaliser
    action: LerobotNormaliser


def read_lerobot_pipeline(folder: Path, config: LerobotConfig) -> LerobotPipeline:
    """Read both pipelines of a checkpoint folder; an error names an unsupported step or setting."""
    before, after = _steps(folder, PREPROCESSOR, _BEFORE), _steps(folder, POSTPROCESSOR, _AFTER)
    for steps, name, where in ((before, _RELATIVE, PREPROCESSOR), (after, _ABSOLUTE, POSTPROCESSOR)):
        if _settings(steps, name).get("enabled"):
            raise UnsupportedLerobotFeature(
                f"'{folder / where}' has {name} enabled: actions relative to the state are not supported."
            )
    state_in_prompt, new_line = _STATE_PROMPT in before, _NEW_LINE in before
    if state_in_prompt != config.pi05 or (new_line and config.pi05):
        raise UnsupportedLerobotFeature(
            f"'{folder / PREPROCESSOR}' makes its prompt with "
            f"{listing(n for n in (_NEW_LINE, _STATE_PROMPT) if n in before)}, but a "
            f"{'pi05' if config.pi05 else 'pi0'} policy has {_STATE_PROMPT if config.pi05 else _NEW_LINE}."
        )
    return LerobotPipeline(
        rename=texts_by_name(
            _settings(before, _RENAME).get("rename_map"), f"'{folder / PREPROCESSOR}' has the rename_map"
        ),
        state_in_prompt=state_in_prompt,
        new_line=new_line,
        cut_long_prompts=_tokenizer_cuts(folder, before, config),
        state=_normaliser(folder, PREPROCESSOR, before, _NORMALIZE, "STATE", STATE_FEATURE, config),
        action=_normaliser(folder, POSTPROCESSOR, after, _UNNORMALIZE, "ACTION", ACTION_FEATURE, config),
    )


def _steps(folder: Path, name: str, known: set[str]) -> dict[str, dict[str, Any]]:
    path = folder / name
    if not path.is_file():
        raise UnsupportedCheckpoint(
            f"'{folder}' has no {name}, which says how a LeRobot policy normalises; a checkpoint saved before LeRobot "
            "kept its pipelines must be migrated with LeRobot's script first."
        )
    steps = read_json_object(path).get("steps")
    by_name: dict[str, dict[str, Any]] = {}
    for step in steps if isinstance(steps, list) else ():
        registered = step.get("registry_name") if isinstance(step, dict) else None
        if not isinstance(registered, str) or registered not in known:
            called = registered or (step.get("class") if isinstance(step, dict) else step)
            raise UnsupportedLerobotFeature(f"'{path}' has a step that is not supported: {called!r}.")
        if registered in by_name and registered not in _NOTHING:
            raise UnsupportedLerobotFeature(f"'{path}' has the step {registered} twice.")
        if not isinstance(step.get("config", {}), dict):
            raise UnsupportedLerobotFeature(f"'{path}' has the step {registered} with settings that are no table.")
        by_name[registered] = step
    return by_name


def _settings(steps: Mapping[str, Mapping[str, Any]], name: str) -> Mapping[str, Any]:
    settings: Mapping[str, Any] = steps.get(name, {}).get("config", {})
    return settings


def _tokenizer_cuts(folder: Path, steps: Mapping[str, Mapping[str, Any]], config: LerobotConfig) -> bool:
    """Check the tokenizer step's settings; returns whether it cuts prompts that are too long."""
    given = _settings(steps, _TOKENIZE)
    wanted = {
        "max_length": config.tokenizer_max_length,
        "padding_side": "right",
        "padding": "max_length",
        "task_key": "task",
    }
    for name, value in wanted.items():
        if given.get(name, value) != value:
            raise UnsupportedLerobotFeature(
                f"'{folder / PREPROCESSOR}' tokenizes with {name} {given[name]!r}; expected {value!r}."
            )
    return bool(given.get("truncation", True))


def _normaliser(
    folder: Path,
    name: str,
    steps: Mapping[str, Mapping[str, Any]],
    registered: str,
    kind: str,
    feature: str,
    config: LerobotConfig,
) -> LerobotNormaliser:
    path, step = folder / name, steps.get(registered)
    if step is None:
        raise UnsupportedCheckpoint(f"'{path}' has no step {registered}, so it does not say how to normalise.")
    settings = _settings(steps, registered)
    modes = {**config.normalization, **texts_by_name(settings.get("norm_map"), f"'{path}' has the norm_map")}
    if modes.get("VISUAL", "IDENTITY") != "IDENTITY":
        raise UnsupportedLerobotFeature(f"'{path}' normalises images by {modes['VISUAL']}; supported is IDENTITY.")
    keys = settings.get("normalize_observation_keys")
    if keys is not None and not isinstance(keys, list):
        raise UnsupportedLerobotFeature(f"'{path}' has normalize_observation_keys {keys!r}; expected a list.")
    mode = "IDENTITY" if keys is not None and kind == "STATE" and feature not in keys else modes.get(kind, "IDENTITY")
    if mode not in _NEEDED:
        raise UnsupportedLerobotFeature(f"'{path}' normalises {kind} by {mode}; supported are {listing(_NEEDED)}.")
    dim = config.state_dim if kind == "STATE" else config.action_dim
    statistics = _statistics(folder, step.get("state_file"), feature, _NEEDED[mode], dim)
    with values_of(path):
        eps = float(settings.get("eps", 1e-8))
    if not 0 <= eps < 1:
        raise UnsupportedLerobotFeature(f"'{path}' has eps {eps}; expected a small number of at least 0.")
    return LerobotNormaliser(mode, statistics, eps)


def _statistics(
    folder: Path, state_file: object, feature: str, needed: Sequence[str], dim: int
) -> dict[str, NDArray[np.float32]]:
    if not needed:
        return {}
    path = folder / str(state_file)
    # A name with folders in it could lead out of the checkpoint.
    if not isinstance(state_file, str) or Path(state_file).name != state_file or not os.path.lexists(path):
        raise UnreadableCheckpoint(f"The statistics of '{feature}' should be in '{path}', which is not there.")
    with open_safetensors(path) as stored:
        present = set(stored.names())
        missing = [f"{feature}.{key}" for key in needed if f"{feature}.{key}" not in present]
        if missing:
            raise UnreadableCheckpoint(f"'{path}' lacks {listing(missing)}; it has {listing(sorted(present))}.")
        return {key: _vector(stored, path, f"{feature}.{key}", dim) for key in needed}


def _vector(stored: SafetensorsFile, path: Path, name: str, dim: int) -> NDArray[np.float32]:
    shape = stored.shape(name)
    if shape != (dim,):
        raise UnreadableCheckpoint(f"The statistics '{name}' of '{path}' have shape {shape}; {dim} numbers are needed.")
    values: NDArray[np.float32] = stored.read(name).float().numpy()
    if not np.isfinite(values).all():
        raise UnreadableCheckpoint(f"The statistics '{name}' of '{path}' hold NaN or infinity.")
    return values
