"""`export`: write a training's averaged weights as a checkpoint folder: openpi's PyTorch format, rounded to bfloat16.

The folder holds the tokenizer and states its own sizes: `capture pi --checkpoint FOLDER` needs nothing else.
"""

from __future__ import annotations

import argparse
import json
import shutil
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch
from safetensors.torch import save_file

from examples.cubes_policy.dataset import new_folder
from examples.cubes_policy.network import small_config
from examples.cubes_policy.training import TOKENIZER, read_average, read_settings
from vla_attention.capture.policies.pi.config import PiConfig
from vla_attention.capture.policies.pi.preprocess import ENVIRONMENT_ACTION_DIM
from vla_attention.capture.policies.pi.tokenizer import PromptTokenizer
from vla_attention.schemas.errors import BadArgument

CARD = "card.json"
#: Sizes that a case.json calls differently, or states elsewhere.
_NOT_SIZES = ("pi05", "cameras", "num_denoise_steps", "time_convention", "min_period", "max_period", "float32_vision")


def config_json(name: str, config: PiConfig) -> dict[str, Any]:
    """Return the content of config.json: the sizes as in a case.json, and the policy's name."""
    sizes = {key: value for key, value in asdict(config).items() if key not in _NOT_SIZES}
    return {
        "name": name,
        "model": "pi05",
        "config": {**sizes, "num_steps": config.num_denoise_steps},
        "layout": {"image_keys": list(config.cameras)},
    }


def norm_stats(state: dict[str, list[float]]) -> dict[str, Any]:
    """Return the content of norm_stats.json: the states' statistics, and actions that stay as they are."""
    dim = ENVIRONMENT_ACTION_DIM
    actions = {"mean": [0.0] * dim, "std": [1.0] * dim, "q01": [-1.0] * dim, "q99": [1.0] * dim}
    return {"norm_stats": {"state": state, "actions": actions}}


def export(training: Path, folder: Path, name: str) -> dict[str, Any]:
    """Write the checkpoint folder of a training; returns its card. An existing folder is refused."""
    if folder.exists():
        raise BadArgument(f"'{folder}' exists already; give another folder for the checkpoint.")
    weights, step, seconds = read_average(training)
    facts = read_settings(training)
    config = small_config(PromptTokenizer(training / TOKENIZER).vocab_size)
    card = {
        "name": name,
        "control": facts["control"],
        "num_tasks": facts["num_tasks"],
        "parameters": sum(tensor.numel() for tensor in weights.values()),
        "precision": "bfloat16, from averaged float32 weights",
        "seed": facts["seed"],
        "batch_size": facts["batch_size"],
        "steps": step,
        "training_minutes": round(seconds / 60, 1),
        "demonstrations": facts["demonstrations"],
        "samples": facts["samples"],
        "instructions": facts["instructions"],
    }
    partial = folder.with_name(folder.name + ".partial")
    shutil.rmtree(partial, ignore_errors=True)
    new_folder(partial, "checkpoint")
    (partial / "assets" / "cubes").mkdir(parents=True)
    rounded = {key: tensor.to(torch.bfloat16).contiguous() for key, tensor in weights.items()}
    save_file(rounded, partial / "model.safetensors")
    for path, content in (
        ("config.json", config_json(name, config)),
        ("assets/cubes/norm_stats.json", norm_stats(facts["state"])),
        (CARD, card),
    ):
        (partial / path).write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
    shutil.copyfile(training / TOKENIZER, partial / "tokenizer.model")
    partial.rename(folder)
    return card


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    parser.add_argument("training", type=Path, metavar="OUTPUT", help="folder of `train`, also while it runs")
    parser.add_argument(
        "folder", type=Path, metavar="FOLDER", help="new folder for vla-attention capture pi --checkpoint"
    )
    parser.add_argument("--name", metavar="NAME", help="name of the policy in stores (default: that of FOLDER)")


def run(arguments: argparse.Namespace) -> int:
    """Export; returns the exit code."""
    name = arguments.name or arguments.folder.absolute().name
    card = export(arguments.training, arguments.folder, name)
    print(
        f"{arguments.folder}: {card['parameters']:,} parameters after {card['steps']} steps, control {card['control']}"
    )
    print(f"Next: vla-attention capture pi --checkpoint {arguments.folder} --task-suite cubes --output cubes.zarr")
    print("Then: python -m examples.cubes_policy rates cubes.zarr")
    return 0
