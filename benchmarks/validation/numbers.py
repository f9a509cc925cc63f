"""What this tool prints of policies whose dependence is known, one value for each trained policy."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl

import vla_attention as va
from benchmarks.validation.calls import NOTHING, changed_episodes
from benchmarks.validation.changes import WRIST_CAMERA, colour_word, known_changes
from vla_attention.analyze.core.action_changes import ActionSpread
from vla_attention.schemas.stores.reader import Store

#: Number -> what it is. Lifts are attention per token over an even spread; all others are effects on the action.
NUMBERS = {
    "lift": "lift of the ratio of pictures to text",
    "lift_instruction": "lift of the instruction's words",
    "lift_verb": "lift of the verb",
    "lift_colour": "lift of the colour's word",
    "lift_wrist": "lift of the wrist camera",
    "noise": "another noise seed",
    "instruction_random": "as many random tokens as the instruction hidden from the action tokens",
    "instruction_action": "the instruction hidden from the action tokens",
    "instruction": "the instruction hidden from all tokens",
    "prompt_empty": "an empty prompt",
    "prompt_other_colour": "another colour in the prompt",
    "colour_action": "the colour hidden from the action tokens",
    "colour_by_pictures": "the colour hidden from the picture tokens",
    "colour_by_text": "the colour hidden from the text tokens",
    "colour": "the colour hidden from all tokens",
    "colour_random": "a random token hidden from all tokens",
    "wrist_random": "as many random tokens as the wrist camera hidden from the action tokens",
    "wrist_action": "the wrist camera hidden from the action tokens",
    "wrist_blank": "a grey wrist camera",
    "mark": "the mark's patches hidden from all tokens",
    "mark_filled": "the mark taken out of the picture",
}


def attention_numbers(store: Store) -> dict[str, float]:
    """Geometric means over the episodes, each of a task of its own."""
    run, overall = va.open(store.path), pl.col("layer") == "layers_avg"
    words = pl.DataFrame(
        [
            (episode.attributes.task_id, episode.attributes.episode_index, colour_word(episode))
            for episode in store.episodes
        ],
        schema={"task_id": pl.Int64, "episode_index": pl.Int64, "colour": pl.String},
        orient="row",
    )
    cameras = run.analyze(grouping="cameras")["episodes_groups"].filter(overall, group=WRIST_CAMERA)
    said = run.analyze(grouping="instruction")["episodes_groups"].filter(overall, group="linguistic")
    found = {
        "lift": run.analyze()["episodes"].filter(overall)["ratio_lift"],
        "lift_instruction": said["lift"],
        "lift_wrist": cameras["lift"],
    }
    if words["colour"].is_not_null().any():
        read = run.words()["words_episodes"].filter(overall)
        read = read.with_columns(pl.col("task_id", "episode_index").cast(pl.Int64))
        named = read.join(words, on=["task_id", "episode_index"])
        found["lift_verb"] = read.filter(kind="place", place=0)["lift"]
        found["lift_colour"] = named.filter(pl.col("item") == pl.col("colour"), kind="word")["lift"]
    return {name: float(np.exp(np.log(values.to_numpy()).mean())) for name, values in found.items()}


def effect_numbers(
    policy: Any, store: Store, spread: ActionSpread, folder: Path, replans: int, say: Callable[[str], None]
) -> dict[str, float]:
    """Means over the episodes, as `vla-attention effects` measures them; `nothing` is the call without a change."""
    values: dict[str, list[float]] = {}
    for episode in changed_episodes(policy, store, known_changes, replans, folder, say):
        for name in episode.actions:
            values.setdefault(name, []).append(float(np.mean(episode.effect(name, spread))))
    found = {name: float(np.mean(of_name)) for name, of_name in values.items()}
    return found | {NOTHING: max(values[NOTHING])}
