"""Recorded effects for other programs: sizes as a table, and the changes of the actions themselves as arrays."""

from __future__ import annotations

from typing import Any

import numpy as np
import polars as pl

from vla_attention.analyze.effects.effect_study import study_effects
from vla_attention.analyze.effects.over_time import effects_by_replan
from vla_attention.analyze.effects.reruns import recorded_conditions
from vla_attention.analyze.measures.question import Question
from vla_attention.schemas.effects import CHANGE
from vla_attention.schemas.errors import BadArgument
from vla_attention.schemas.safe_text import visible


def effect_table(question: Question) -> pl.DataFrame:
    """`effects_by_replan` of every store of a question.

    Raises:
        BadArgument: none of the stores recorded effects.
    """
    having = [store for store in question.stores if recorded_conditions(store)]
    if not having:
        raise BadArgument(
            "These stores hold no effects; record them with vla-capture --effects text,cameras, or choose other tables."
        )
    return pl.concat([effects_by_replan(study_effects(store.path, [], question.settings)) for store in having])


def effect_arrays(question: Question) -> dict[str, Any]:
    """Variables of a dataset; nothing where no effects were recorded.

    `effect_change` (entry, step, dimension): the changes of the normalised actions; `effect_units` (entry, dimension):
    how far 1 of them moves the robot; `effect_sample` and `effect_condition` (entry): which sample it is of, and what
    was changed.
    """
    changes, units, samples, conditions = [], [], [], []
    first = 0
    for item in question.selected:
        effects = item.episode.attributes.effects
        if effects is not None and effects.replan:
            changes.append(item.episode.read(CHANGE))
            units += [effects.units] * len(effects.replan)
            samples += [first + replan for replan in effects.replan]
            conditions += [visible(effects.conditions[number].name) for number in effects.condition]
        first += item.episode.attributes.num_replans
    if not changes or len({change.shape[1:] for change in changes}) > 1:  # stores of different policies
        return {}
    meaning = {"long_name": "actions under a condition minus actions, normalised", "units": "1"}
    return {
        "effect_change": (("entry", "step", "dimension"), np.concatenate(changes), meaning),
        "effect_units": (("entry", "dimension"), np.array(units), {"long_name": "units of the environment in 1"}),
        "effect_sample": ("entry", np.array(samples, np.int64), {"long_name": "number of the sample, from 0"}),
        "effect_condition": ("entry", np.array(conditions), {"long_name": "what was changed"}),
    }
