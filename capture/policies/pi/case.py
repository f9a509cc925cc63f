"""Parity cases of the pi models: checkpoints, inputs, and the results of a reference implementation.

case.json states the sizes that no checkpoint states. It is also used for a checkpoint in a folder beside it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch

from vla_attention.capture.policies.checkpoints import (
    MAX_BLOCKS,
    MAX_SIZE,
    MAX_STEPS,
    check_size,
    read_json_object,
)
from vla_attention.capture.policies.parity_case import CASE_FILE, UnusableCase, case_name, read_arrays, read_case_file
from vla_attention.capture.policies.pi.config import CAMERA_SLOTS, GemmaConfig, PiConfig, SiglipConfig
from vla_attention.capture.policies.pi.formats import CheckpointFormat
from vla_attention.capture.policies.pi.lerobot_config import MAX_CAMERAS
from vla_attention.capture.policies.weights import DTYPES
from vla_attention.schemas.errors import BadArgument, listing, unknown_name
from vla_attention.schemas.safe_text import check_name, check_text

#: File of a checkpoint in openpi's PyTorch format that may state the sizes, in the form of a case.json.
CONFIG_FILE = "config.json"

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

    def checkpoint(self, case_format: CaseFormat) -> tuple[Path, CheckpointFormat]:
        """Return the folder of the checkpoint in a format; `UnusableCase` lists the existing formats."""
        if case_format not in self.formats:
            raise UnusableCase(
                f"The case '{self.folder}' carries no checkpoint in the format '{case_format}' (folder "
                f"{CHECKPOINT_FOLDERS[case_format][0]}); it carries {listing(self.formats)}."
            )
        name, checkpoint_format = CHECKPOINT_FOLDERS[case_format]
        return self.folder / name, checkpoint_format


def find_case_format(name: str) -> CaseFormat:
    """Return the format of that name; `UnknownName` lists the three."""
    for known in CHECKPOINT_FOLDERS:
        if known == name:
            return known
    raise unknown_name("case format", name, CHECKPOINT_FOLDERS)


def read_config(path: Path) -> PiConfig:
    """Read the sizes of a model from a case.json, or from a file with its `model` and `config`."""
    if not path.is_file():
        raise UnusableCase(f"There is no '{path}', which states the sizes of the model.")
    content = read_json_object(path)
    try:
        return _config(content, path)
    except (KeyError, TypeError, AttributeError) as error:
        raise UnusableCase(
            f"'{path}' does not state the sizes of a pi model: {error!s} is missing or wrong; expected 'model' (pi0 or "
            "pi05) and 'config' with paligemma, action_expert, siglip, vocab_size, action_dim, action_horizon, "
            "max_token_len, num_steps."
        ) from error


def states_sizes(path: Path) -> bool:
    """Return whether there is a config.json that states all sizes, like a case.json (`examples/cubes_policy`)."""
    if not path.is_file():
        return False
    content = read_json_object(path)
    return "model" in content and isinstance(content.get("config"), Mapping)


def stated_name(path: Path) -> str | None:
    """Return the name that a checkpoint's config.json gives its policy, if its sizes are stated there, too."""
    if not states_sizes(path):
        return None
    name = read_json_object(path).get("name")
    if not isinstance(name, str) or not name:
        return None
    check_text("policy", name)
    return name


def _config(content: Mapping[str, Any], path: Path) -> PiConfig:
    sizes: Mapping[str, Any] = content["config"]
    model = content["model"]
    if model not in ("pi0", "pi05"):
        raise BadArgument(f"A case is of model 'pi0' or 'pi05', not '{model}'.")

    def size(name: str, value: object) -> int:
        # Those of blocks and steps are in no tensor's shape.
        most = {"depth": MAX_BLOCKS, "action_horizon": MAX_STEPS, "max_token_len": MAX_STEPS, "num_steps": MAX_STEPS}
        return check_size(f"'{name}' of '{path}'", value, most.get(name, MAX_SIZE))

    def part(name: str, ignored: str) -> dict[str, int]:
        return {key: size(key, value) for key, value in sizes[name].items() if key != ignored}

    layout: Mapping[str, Any] = content.get("layout", {})
    cameras = layout.get("image_keys", CAMERA_SLOTS)
    if not isinstance(cameras, (list, tuple)) or len(cameras) > MAX_CAMERAS:
        raise TypeError("image_keys")
    for camera in cameras:
        check_name("camera", str(camera))
    return PiConfig(
        paligemma=GemmaConfig(**part("paligemma", "lora_configs")),
        action_expert=GemmaConfig(**part("action_expert", "lora_configs")),
        siglip=SiglipConfig(**part("siglip", "num_classes")),
        vocab_size=size("vocab_size", sizes["vocab_size"]),
        action_dim=size("action_dim", sizes["action_dim"]),
        action_horizon=size("action_horizon", sizes["action_horizon"]),
        max_token_len=size("max_token_len", sizes["max_token_len"]),
        num_denoise_steps=size("num_steps", sizes["num_steps"]),
        pi05=model == "pi05",
        discrete_state_input=bool(sizes.get("discrete_state_input", False)),
        cameras=tuple(map(str, cameras)),
    )


def read_case(folder: str | Path) -> Case:
    """Read a case folder; `UnusableCase` names the file or array that is missing or of the wrong shape."""
    folder = Path(folder)
    content = read_case_file(folder)
    config = read_config(folder / CASE_FILE)
    computed = str(content.get("compute_dtype", "float32"))
    if computed not in DTYPES:
        raise UnusableCase(f"'{folder / CASE_FILE}' says compute_dtype '{computed}'; expected float32 or bfloat16.")
    inputs, expected = read_arrays(folder / "inputs.npz"), read_arrays(folder / "expected.npz")
    _check_shapes(folder / "inputs.npz", inputs, _input_shapes(config, inputs))
    _check_shapes(folder / "expected.npz", expected, _expected_shapes(config, inputs))
    return Case(case_name(content, folder), folder, config, DTYPES[computed], inputs, expected)


Wanted = dict[str, tuple[int, ...]]


def _input_shapes(config: PiConfig, inputs: Mapping[str, np.ndarray]) -> Wanted:
    batch = len(inputs["noise"]) if "noise" in inputs and inputs["noise"].ndim else 1
    size = config.siglip.image_size
    text = (batch, config.max_token_len)
    # The noise is checked first, because the batch size comes from it.
    wanted: Wanted = {"noise": (batch, config.action_horizon, config.action_dim), "num_steps": ()}
    wanted |= {f"image_{camera}": (batch, size, size, 3) for camera in config.cameras}
    wanted |= {f"image_mask_{camera}": (batch,) for camera in config.cameras}
    wanted |= {"tokenized_prompt": text, "tokenized_prompt_mask": text}
    return wanted | {"state": (batch, config.action_dim)}


def _expected_shapes(config: PiConfig, inputs: Mapping[str, np.ndarray]) -> Wanted:
    batch, expert = len(inputs["noise"]), config.action_expert
    rows = (int(inputs["num_steps"]), expert.depth, batch, expert.num_heads, config.suffix_len, config.key_len)
    return {"actions": (batch, config.action_horizon, config.action_dim), "attn": rows}


def _check_shapes(path: Path, arrays: Mapping[str, np.ndarray], wanted: Wanted) -> None:
    for name, shape in wanted.items():
        if name not in arrays:
            raise UnusableCase(f"'{path}' has no array '{name}'; it has {listing(sorted(arrays))}.")
        if arrays[name].shape != shape:
            raise UnusableCase(
                f"'{name}' of '{path}' has shape {arrays[name].shape}, but the sizes of {CASE_FILE} make it {shape}."
            )
