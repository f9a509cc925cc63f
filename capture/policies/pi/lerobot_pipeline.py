"""LeRobot's saved pre- and postprocessing: policy_preprocessor.json, policy_postprocessor.json and their state files.

Steps are found by their registered names, because their numbers differ between versions and between pi0 and pi0.5. An
unknown step is an error with its name: it could change the inputs or actions of the policy.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import msgspec
import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from vla_attention.capture.policies.checkpoints import (
    CheckpointNotFound,
    UnreadableCheckpoint,
    UnsupportedCheckpoint,
    read_typed,
)
from vla_attention.capture.policies.pi.formats import PREPROCESSOR
from vla_attention.capture.policies.pi.lerobot_config import ACTION_FEATURE, STATE_FEATURE, LerobotConfig
from vla_attention.capture.policies.pi.preprocess import Normaliser
from vla_attention.capture.policies.pi.tokenizer import PromptFormat
from vla_attention.capture.policies.safetensors_file import open_safetensors
from vla_attention.schemas.checked_files import read_object
from vla_attention.schemas.errors import listing

POSTPROCESSOR = "policy_postprocessor.json"

_RENAME, _NORMALIZE, _UNNORMALIZE = "rename_observations_processor", "normalizer_processor", "unnormalizer_processor"
_NEW_LINE, _STATE_PROMPT = "pi0_new_line_processor", "pi05_prepare_state_tokenizer_processor_step"
_TOKENIZE, _RELATIVE, _ABSOLUTE = "tokenizer_processor", "relative_actions_processor", "absolute_actions_processor"
#: Steps without effect here: batching, moving to a device.
_NOTHING = {"to_batch_processor", "device_processor"}
_BEFORE = _NOTHING | {_RENAME, _NORMALIZE, _NEW_LINE, _STATE_PROMPT, _TOKENIZE, _RELATIVE}
_AFTER = _NOTHING | {_UNNORMALIZE, _ABSOLUTE}

_GIVE_THEM = "give those of its data set with --norm-stats FILE (meta/stats.json of a LeRobotDataset 2.0 or 3.0)"
#: Statistics of each mode of normalisation.
_NEEDED = {"IDENTITY": (), "MEAN_STD": ("mean", "std"), "QUANTILES": ("q01", "q99")}


class _Settings(msgspec.Struct, frozen=True):
    """Settings of all steps that are read, with LeRobot's defaults."""

    rename_map: dict[str, str] | None = None
    enabled: bool | None = None
    norm_map: dict[str, str] | None = None
    normalize_observation_keys: list[str] | None = None
    eps: Annotated[float, Meta(ge=0, lt=1)] = 1e-8
    max_length: int | None = None
    padding_side: str = "right"
    padding: str = "max_length"
    task_key: str = "task"
    truncation: bool = True


class _Step(msgspec.Struct, frozen=True):
    registry_name: str | None = None
    #: of a step that is no registered one
    class_: str | None = msgspec.field(name="class", default=None)
    config: _Settings = _Settings()
    state_file: str | None = None


class _Pipeline(msgspec.Struct, frozen=True):
    steps: list[_Step]


@dataclass(frozen=True)
class LerobotPipeline:
    """Content of the two saved pipelines: camera names, prompt format, normalisation of state and action."""

    rename: dict[str, str]
    prompt_format: PromptFormat
    cut_long_prompts: bool
    state: Normaliser
    action: Normaliser


def read_lerobot_pipeline(folder: Path, config: LerobotConfig, norm_stats: Path | None = None) -> LerobotPipeline:
    """Read both pipelines of a checkpoint folder; an error names an unsupported step or setting.

    norm_stats: a data set's `meta/stats.json`, which counts instead of the checkpoint's own statistics.
    """
    before, after = _steps(folder, PREPROCESSOR, _BEFORE), _steps(folder, POSTPROCESSOR, _AFTER)
    state_in_prompt, new_line = _STATE_PROMPT in before, _NEW_LINE in before
    if state_in_prompt != config.pi05 or (new_line and config.pi05):
        raise UnsupportedCheckpoint(
            f"'{folder / PREPROCESSOR}' makes its prompt with "
            f"{listing(n for n in (_NEW_LINE, _STATE_PROMPT) if n in before)}, but a "
            f"{'pi05' if config.pi05 else 'pi0'} policy has {_STATE_PROMPT if config.pi05 else _NEW_LINE}."
        )
    tokenizer = before.get(_TOKENIZE, _Step()).config
    for setting, given, wanted in (
        ("max_length", tokenizer.max_length or config.max_token_len, config.max_token_len),
        ("padding_side", tokenizer.padding_side, "right"),
        ("padding", tokenizer.padding, "max_length"),
        ("task_key", tokenizer.task_key, "task"),
    ):
        if given != wanted:
            raise UnsupportedCheckpoint(
                f"'{folder / PREPROCESSOR}' tokenizes with {setting} {given!r}; expected {wanted!r}."
            )
    without_state: PromptFormat = "raw-instruction-newline" if new_line else "raw-instruction"
    return LerobotPipeline(
        rename=before.get(_RENAME, _Step()).config.rename_map or {},
        prompt_format="task-state-action" if state_in_prompt else without_state,
        cut_long_prompts=tokenizer.truncation,
        state=_normaliser(folder / PREPROCESSOR, before.get(_NORMALIZE), "STATE", config, norm_stats),
        action=_normaliser(folder / POSTPROCESSOR, after.get(_UNNORMALIZE), "ACTION", config, norm_stats),
    )


def _steps(folder: Path, name: str, known: set[str]) -> dict[str, _Step]:
    path = folder / name
    if not path.is_file():
        raise UnsupportedCheckpoint(
            f"'{folder}' has no {name}, which says how a LeRobot policy normalises; a checkpoint saved before LeRobot "
            "kept its pipelines must be migrated with LeRobot's script first."
        )
    by_name: dict[str, _Step] = {}
    for step in read_typed(path, _Pipeline).steps:
        if step.registry_name is None or step.registry_name not in known:
            called = step.registry_name or step.class_
            raise UnsupportedCheckpoint(f"'{path}' has a step that is not supported: {called!r}.")
        if step.registry_name in by_name and step.registry_name not in _NOTHING:
            raise UnsupportedCheckpoint(f"'{path}' has the step {step.registry_name} twice.")
        if step.registry_name in (_RELATIVE, _ABSOLUTE) and step.config.enabled:
            raise UnsupportedCheckpoint(
                f"'{path}' has {step.registry_name} enabled: actions relative to the state are not supported."
            )
        by_name[step.registry_name] = step
    return by_name


def _normaliser(
    path: Path, step: _Step | None, kind: Literal["STATE", "ACTION"], config: LerobotConfig, norm_stats: Path | None
) -> Normaliser:
    feature = STATE_FEATURE if kind == "STATE" else ACTION_FEATURE
    if step is None:
        raise UnsupportedCheckpoint(f"'{path}' has no step that says how to normalise {feature}.")
    modes = {**(config.normalization_mapping or {}), **(step.config.norm_map or {})}
    keys, mode = step.config.normalize_observation_keys, modes.get(kind, "IDENTITY")
    if modes.get("VISUAL", "IDENTITY") != "IDENTITY":
        raise UnsupportedCheckpoint(f"'{path}' normalises images by {modes['VISUAL']}; supported is IDENTITY.")
    if keys is not None and kind == "STATE" and feature not in keys:
        mode = "IDENTITY"
    if mode not in _NEEDED:
        raise UnsupportedCheckpoint(f"'{path}' normalises {kind} by {mode}; supported are {listing(_NEEDED)}.")
    dim = config.state_dim if kind == "STATE" else config.action_dim
    statistics = {}
    if _NEEDED[mode]:
        given = None if norm_stats is None else norm_stats.expanduser()
        place = _place_of_statistics(path, step.state_file or "", feature) if given is None else given
        read = _of_checkpoint if given is None else _of_data_set
        statistics = read(place, feature, _NEEDED[mode], dim)
    return lerobot_normaliser(mode, statistics, step.config.eps, dim)


def lerobot_normaliser(mode: str, statistics: Mapping[str, NDArray[np.float32]], eps: float, dim: int) -> Normaliser:
    """Return the normalisation of a vector as LeRobot computes it, in float32.

    mode: IDENTITY, MEAN_STD ((x - mean)/(std + eps), inverse x·std + mean) or QUANTILES (2(x - q01)/(q99 - q01) - 1,
    where a range of 0 counts as eps). statistics: each (dim,) float32.
    """
    if mode == "MEAN_STD":
        std = statistics["std"]
        return Normaliser(mode, statistics["mean"], std + np.float32(eps), std)
    if mode == "QUANTILES":
        span = statistics["q99"] - statistics["q01"]
        span = np.where(span == 0, np.float32(eps), span)
        return Normaliser(mode, statistics["q01"], span, span, is_range=True)
    one = np.ones(dim, dtype=np.float32)
    return Normaliser(mode, 0 * one, one, one)


def _place_of_statistics(pipeline: Path, state_file: str, feature: str) -> Path:
    if not state_file:
        raise UnreadableCheckpoint(f"'{pipeline}' names no file with the statistics of '{feature}'; {_GIVE_THEM}.")
    path = pipeline.parent / state_file
    # A name with folders in it could lead out of the checkpoint.
    if Path(state_file).name != state_file or not path.exists():
        raise UnreadableCheckpoint(
            f"The statistics of '{feature}' should be in '{path}', which is not there; {_GIVE_THEM}."
        )
    return path


def _of_checkpoint(path: Path, feature: str, needed: Sequence[str], dim: int) -> dict[str, NDArray[np.float32]]:
    with open_safetensors(path) as stored:
        shapes = stored.shapes()
        for key in needed:
            _check_shape(path, f"{feature}.{key}", shapes.get(f"{feature}.{key}"), dim)
        values = {key: stored.read(f"{feature}.{key}").float().numpy() for key in needed}
    return _finite(path, feature, values)


def _of_data_set(path: Path, feature: str, needed: Sequence[str], dim: int) -> dict[str, NDArray[np.float32]]:
    try:
        of_feature = read_object(path, UnreadableCheckpoint).get(feature)
    except FileNotFoundError:
        raise CheckpointNotFound(f"There is no file of statistics at '{path}'.") from None
    values = {}
    for key in needed:
        try:
            values[key] = np.asarray(of_feature[key], dtype=np.float32)  # type: ignore[index]
        except (KeyError, TypeError, ValueError):
            raise UnreadableCheckpoint(
                f"'{path}' has no numbers '{key}' of '{feature}', which the policy needs; expected the "
                "meta/stats.json of a LeRobotDataset."
            ) from None
        _check_shape(path, f"{feature}.{key}", values[key].shape, dim)
    return _finite(path, feature, values)


def _check_shape(path: Path, name: str, shape: tuple[int, ...] | None, dim: int) -> None:
    if shape != (dim,):
        raise UnreadableCheckpoint(
            f"The statistics '{name}' of '{path}' have shape {shape or 'none'}; {dim} numbers are needed."
        )


def _finite(path: Path, feature: str, values: dict[str, NDArray[np.float32]]) -> dict[str, NDArray[np.float32]]:
    for key, numbers in values.items():
        if not np.isfinite(numbers).all():
            raise UnreadableCheckpoint(f"The statistics '{feature}.{key}' of '{path}' hold NaN or infinity.")
    return values
