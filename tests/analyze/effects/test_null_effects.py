"""What the sentences name where nothing exceeds the noise, and where something does. Tables are made, not stores."""

from __future__ import annotations

import numpy as np
import polars as pl
import pytest

from vla_attention.analyze.effects.conditions import Condition, Kind
from vla_attention.analyze.effects.floors import summary_of, with_floors
from vla_attention.analyze.effects.paired_replans import ALL
from vla_attention.analyze.statistics.episode_intervals import Sampling
from vla_attention.schemas.interventions import Interventions, KeyKnockout, NoiseChange

TASKS, EPISODES, GROUPS, DRAWS = 6, 3, 8, 30
CONDITIONS = [
    Condition("noise", None, Interventions("noise", noise=NoiseChange(1))),
    *(Condition(f"without_{i}", None, Interventions(f"without_{i}", keys=(KeyKnockout(f"keys:{i}"),)))
      for i in range(GROUPS)),
    *(Condition(f"random_{i}", None, Interventions(f"random_{i}", keys=(KeyKnockout(f"keys:{i}", random_seed=1),)))
      for i in range(GROUPS)),
]  # fmt: skip


def drawn_table(seed: int, planted: float = 0.0) -> pl.DataFrame:
    """Effects that scatter over tasks and episodes around one mean; that of group 0 may be larger."""
    generator = np.random.default_rng(seed)
    # Scenes differ, and all conditions of a scene with them.
    scene = generator.normal(0, 0.2, (TASKS, EPISODES))
    rows = []
    for condition in CONDITIONS:
        own = generator.normal(0, 0.15, TASKS)
        for task in range(TASKS):
            for episode in range(EPISODES):
                effect = np.exp(scene[task, episode] + own[task] + generator.normal(0, 0.2)) - 1 + 0.5
                more = planted if condition.name == "without_0" else 0.0
                rows.append(("s", task, "do it", episode, condition.name, condition.kind.value, effect + more))
    names = ["suite", "task_id", "instruction", "episode_index", "condition", "kind", "effect"]
    empty = ("effect_chunk", "angle", "gripper_flips", "mass", "lift", "norm", "keys")
    return pl.DataFrame(rows, schema=names, orient="row").with_columns(
        pl.lit(ALL).alias("phase"),
        *(pl.lit(None, dtype=pl.String).alias(name) for name in ("group", "selector")),
        *(pl.lit(None, dtype=pl.Float64).alias(name) for name in empty),
    )


def named(table: pl.DataFrame, floor: str) -> list[str]:
    """The conditions that a sentence names as exceeding a floor."""
    summary = summary_of(with_floors(table, CONDITIONS), Sampling()).filter(scope="all", kind=Kind.WITHOUT.value)
    return summary.filter(pl.col(floor) > 0, pl.col(f"{floor}_q") <= 0.025)["condition"].to_list()


@pytest.mark.thorough
def test_nothing_is_named_where_nothing_exceeds_the_floors():
    tables = [drawn_table(seed) for seed in range(DRAWS)]
    both = [bool(named(table, "minus_noise")) + bool(named(table, "minus_random")) > 0 for table in tables]
    # 5 % is promised; the chance of more than 5 of 30 is then below 1 %.
    assert sum(both) <= 5


def test_what_is_planted_is_named():
    found = [named(drawn_table(seed, planted=0.8), "minus_noise") for seed in range(10)]
    assert sum("without_0" in names for names in found) >= 9
