"""Short names of interventions: the default name of a condition, which becomes part of a file's name."""

from __future__ import annotations

import re

from vla_attention.schemas.interventions import (
    AttentionScale,
    AttentionUniform,
    ImageChange,
    Interventions,
    KeyKnockout,
    PromptChange,
)

#: Longest name; what is longer is cut, and the store says the whole.
_LONGEST = 80


def condition_name(interventions: Interventions) -> str:
    """Return a name such as `without_camera_base_0_rgb`, of letters, digits, `_`, `.` and `+`; empty for no change."""
    parts = [_of_knockout(change) for change in interventions.keys]
    parts += [_of_attention(change) for change in interventions.attention]
    parts += [_of_prompt(interventions.prompt)] if interventions.prompt else []
    parts += [_of_image(change) for change in interventions.images]
    parts += [f"noise_{interventions.noise.seed}"] if interventions.noise else []
    return "+".join(_plain(part) for part in parts)[:_LONGEST]


def _plain(text: str) -> str:
    return re.sub(r"[^\w.]+", "_", text).strip("_")


def _of_knockout(change: KeyKnockout) -> str:
    kind = "random" if change.random_seed is not None else "only" if change.keep else "without"
    return f"{kind}_{change.selector}"


def _of_attention(change: AttentionScale | AttentionUniform) -> str:
    if isinstance(change, AttentionUniform):
        return f"uniform_{change.selector}"
    return f"{change.selector}_times_{change.factor:g}"


def _of_prompt(change: PromptChange) -> str:
    detail = {"task": f"_{change.task_id}", "text": f"_{change.text}"}.get(change.kind, "")
    return f"prompt_{change.kind}{detail}"


def _of_image(change: ImageChange) -> str:
    detail = f"_{change.object}" if change.object else ""
    detail += f"_{change.rows}_{change.columns}" if change.kind == "shifted" else ""
    return f"{change.camera}_{change.kind}{detail}"
