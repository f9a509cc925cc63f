"""Made-up steps, as a wide table whose measures are computed here, and as the masses that an analysis begins with."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import polars as pl

from vla_attention.analyze.core.levels import SIDES, Levels, task_cells, task_groups
from vla_attention.analyze.core.measure import Measured
from vla_attention.analyze.measures.tables import EPISODE_ID, EPISODE_KEYS
from vla_attention.analyze.published.results_writer import documents_of, write_results
from vla_attention.analyze.statistics.units import Sampling
from vla_attention.analyze.stores.selection import Selection
from vla_attention.schemas.groupings.grouping import Grouping, Ratio
from vla_attention.schemas.results import FrameProxy, results_file_name

#: Keys per group of the default grouping in something like pi0.5 with two cameras.
DEFAULT_KEYS = {
    "visual": 512.0,
    "linguistic": 14.0,
    "state": 24.0,
    "action": 50.0,
    "padding": 162.0,
    "masked": 256.0,
    "other": 0.0,
}
#: Groups whose keys are masked out: no mass, not valid.
INVALID = ("padding", "masked")
CUSTOM_KEYS = {
    "base": 256.0,
    "wrist": 256.0,
    "nouns": 3.0,
    "target": 7.25,
    "verbs": 2.0,
    "rest": 74.0,
}
INSTRUCTIONS = (
    "put both the alphabet soup and the tomato sauce in the basket",
    "turn on the stove and put the moka pot on it",
    "pick up the book and place it in the back compartment of the caddy",
    "put the $5 mug_1 on the left $plate_2 and the other mug on the right plate, "
    "then close the bottom drawer of the cabinet",
)


def default_grouping() -> Grouping:
    groups = {
        "visual": ("role:image",),
        "linguistic": ("role:instruction | role:bos",),
        "state": ("role:state",),
        "action": ("role:action",),
        "padding": ("role:padding",),
        "masked": ("role:masked_image",),
        "other": ("*",),
    }
    return Grouping(
        "default", groups, Ratio(("visual",), ("linguistic",)), description="visual = every valid image key"
    )


def custom_grouping(with_ratio: bool = True) -> Grouping:
    groups = {name: ("*",) if name == "rest" else (f"span:{name}",) for name in CUSTOM_KEYS}
    return Grouping("cameras-and-words", groups, Ratio(("base", "wrist"), ("nouns",)) if with_ratio else None)


def many_groups(count: int = 14) -> tuple[Grouping, dict[str, float]]:
    keys = {f"akita_black_bowl_{i}": 5.0 + i for i in range(count - 2)} | {"linguistic": 12.0, "other": 500.0}
    groups = {name: (f"span:{name}",) for name in keys}
    return Grouping("objects", groups, Ratio(tuple(keys)[: count - 2], ("linguistic",))), keys


def make_steps(
    grouping: Grouping | None = None,
    keys: Mapping[str, float] | None = None,
    *,
    num_tasks: int = 2,
    num_episodes: int = 3,
    layers: tuple[int, ...] = (18, 25, 35),
    num_replans: int = 6,
    denoise_steps: tuple[int, ...] = (0, 9),
    heads: tuple[int, ...] | None = None,
    no_denominator: float = 0.0,
    suite: str = "libero_10",
    seed: int = 0,
) -> pl.DataFrame:
    """Steps with smooth changes over time, and differences between layers, tasks and episodes.

    `no_denominator`: share of (episode, replan) pairs whose denominator groups get no mass (ratio +inf).
    """
    grouping = grouping or default_grouping()
    keys = dict(keys or DEFAULT_KEYS)
    generator = np.random.default_rng(seed)
    axes = (num_tasks, num_episodes, num_replans, len(layers), len(denoise_steps), len(heads or (0,)))
    task, episode, replan, layer, denoise, head = (part.ravel() for part in np.indices(axes))
    number = {name: i for i, name in enumerate(keys)}
    logits = np.zeros((len(task), len(keys)))
    for name, i in number.items():
        logits[:, i] = np.log(max(keys[name], 1e-9))
        logits[:, i] += generator.normal(0, 0.5, len(layers))[layer] + generator.normal(0, 0.3, num_tasks)[task]
        logits[:, i] += generator.normal(0, 0.25, (num_tasks, num_episodes))[task, episode]
        drift = generator.normal(0, 0.15, (num_tasks, num_episodes, num_replans)).cumsum(axis=2)
        logits[:, i] += drift[task, episode, replan] + generator.normal(0, 0.05, len(task))
        if name in INVALID or keys[name] == 0:
            logits[:, i] = -np.inf
    if grouping.ratio and no_denominator:
        hit = generator.random((num_tasks, num_episodes, num_replans)) < no_denominator
        for name in grouping.ratio.denominator:
            logits[hit[task, episode, replan], number[name]] = -np.inf
    weights = np.exp(logits - logits.max(axis=1, keepdims=True))
    masses = weights / weights.sum(axis=1, keepdims=True)
    num_valid = sum(count for name, count in keys.items() if name not in INVALID)
    steps_of = generator.integers(num_replans * 5 - 4, num_replans * 5 + 1, (num_tasks, num_episodes))
    success = generator.random((num_tasks, num_episodes)) < 0.7
    columns: dict[str, object] = {
        "suite": [suite] * len(task),
        "task_id": task,
        "instruction": [INSTRUCTIONS[i % len(INSTRUCTIONS)] for i in task],
        "episode_index": episode,
        "success": success[task, episode],
        "num_steps": steps_of[task, episode],
        "replan": replan,
        "env_step": 10 + 5 * replan,
        "layer": np.array(layers)[layer],
        "block": np.array(layers)[layer] % 18,
        "denoise_step": np.array(denoise_steps)[denoise],
        "denoise_time": 1.0 - np.array(denoise_steps)[denoise] / 10.0,
        "head": pl.Series([None] * len(task), dtype=pl.Int64) if heads is None else np.array(heads)[head],
        "row_sum": np.ones(len(task)),
        "valid_mass": np.ones(len(task)),
        "num_valid": np.full(len(task), round(num_valid)),
    }
    for name, i in number.items():
        columns[f"{name}_mass"] = masses[:, i]
        columns[f"{name}_fraction"] = masses[:, i] / masses.sum(axis=1)
        columns[f"{name}_keys"] = np.full(len(task), keys[name])
        density = masses[:, i] / keys[name] if keys[name] else None
        columns[f"{name}_density"] = pl.Series([None] * len(task), dtype=pl.Float64) if density is None else density
        lift = masses[:, i] / keys[name] * round(num_valid) if keys[name] else None
        columns[f"{name}_lift"] = pl.Series([None] * len(task), dtype=pl.Float64) if lift is None else lift
    if grouping.ratio:
        above = sum(masses[:, number[name]] for name in grouping.ratio.numerator)
        below = sum(masses[:, number[name]] for name in grouping.ratio.denominator)
        with np.errstate(divide="ignore"):
            ratio = above / below
        uniform = sum(keys[n] for n in grouping.ratio.numerator) / sum(keys[n] for n in grouping.ratio.denominator)
        columns |= {"numerator_mass": above, "denominator_mass": below, "ratio": ratio}
        columns |= {"uniform_ratio": np.full(len(task), uniform), "ratio_lift": ratio / uniform}
        columns["log2_ratio"] = np.log2(ratio)
    return pl.DataFrame(columns)


def measured_of(steps: pl.DataFrame, grouping: Grouping) -> list[Measured]:
    """The episodes of `make_steps` (in any order of its rows) as measured masses."""
    return [_measured(part, grouping) for part in steps.partition_by(EPISODE_ID, maintain_order=True)]


@dataclass(frozen=True)
class Made:
    """The cells of a level, and their groups."""

    cells: pl.DataFrame
    groups: pl.DataFrame
    measured: Sequence[Measured] = ()

    def of_group(self, name: str) -> pl.DataFrame:
        """The rows of one group."""
        return self.groups.filter(group=name)

    @property
    def flat(self) -> pl.DataFrame:
        """Cells with a column `{group}_{measure}` for each group and measure."""
        shared = [name for name in self.groups.columns if name in self.cells.columns]
        keys = [name for name in shared if name not in ("num_episodes", "num_tasks", "num_families", "intervals")]
        found = self.cells
        for name in self.groups["group"].unique(maintain_order=True):
            own = self.groups.filter(group=name).drop("group")
            named = own.rename({column: f"{name}_{column}" for column in own.columns if column not in keys})
            found = found.join(named, on=keys, how="left", nulls_equal=True, maintain_order="left")
        return found


def made_levels(steps: pl.DataFrame, grouping: Grouping) -> Levels:
    measured = measured_of(steps, grouping)
    question: Any = SimpleNamespace(grouping=grouping, selection=measured[0].selection)
    return Levels(question, measured, measured[0].mass.shape[3] > 1)


def steps_of(levels: Levels) -> Made:
    return Made(levels.steps().collect(), levels.steps_groups().collect())


def replans_of(steps: pl.DataFrame, grouping: Grouping) -> Made:
    levels = made_levels(steps, grouping)
    return Made(levels.replans().collect(), levels.groups("replan", "layer").collect(), levels.measured)


def flat(made: Made) -> pl.DataFrame:
    return made.flat


def write_results_of_suites(
    folder: Path, made: Made, grouping: Grouping, denoise_steps: Sequence[int], proxy: FrameProxy | None = None
) -> list[Path]:
    """The results files of made-up replans."""
    paths = []
    folder.mkdir(parents=True, exist_ok=True)
    for suite in dict.fromkeys(one.item.store.suite for one in made.measured):
        paths.append(folder / results_file_name(suite))
        of_suite = [one for one in made.measured if one.item.store.suite == suite]
        write_results(paths[-1], documents_of(of_suite, range(len(of_suite)), grouping, denoise_steps, proxy))
    return paths


def episodes_of(steps: pl.DataFrame, grouping: Grouping) -> Made:
    levels = made_levels(steps, grouping)
    return Made(levels.episodes(), levels.episodes_groups())


def tasks_of(steps: pl.DataFrame, grouping: Grouping) -> Made:
    episodes = episodes_of(steps, grouping)
    return Made(task_cells(episodes.cells, Sampling()), task_groups(episodes.groups, Sampling()))


def _measured(part: pl.DataFrame, grouping: Grouping) -> Measured:
    part = part.sort("replan", "layer", "denoise_step", "head")
    layers, steps, heads = (
        part[name].unique(maintain_order=True).to_list() for name in ("layer", "denoise_step", "head")
    )
    blocks = dict(part.select("layer", "block").unique().iter_rows())
    replans = part.unique("replan", maintain_order=True)
    shape = (replans.height, len(layers), len(steps), len(heads))
    selection = Selection(
        layers=tuple(range(len(layers))),
        layer_labels=tuple(layers),
        blocks=tuple(blocks[layer] for layer in layers),
        denoise=tuple(range(len(steps))),
        denoise_steps=tuple(steps),
        heads=tuple(range(len(heads))),
        head_numbers=tuple(head or 0 for head in heads),
        per_head=heads != [None],
    )
    arrays = {
        "env_step": replans["env_step"].to_numpy(),
        "denoise_time": part["denoise_time"].unique(maintain_order=True).to_numpy(),
    }
    first = part.row(0, named=True)
    episode = SimpleNamespace(
        attributes=SimpleNamespace(**{name: first[name] for name in EPISODE_KEYS}), read=lambda name: arrays[name]
    )
    key = tuple(first[name] for name in EPISODE_ID)
    item: Any = SimpleNamespace(store=SimpleNamespace(suite=first["suite"]), episode=episode, key=key)

    def of(names: Sequence[str], table: pl.DataFrame = part) -> Any:
        return table.select(pl.col(names).cast(pl.Float64)).to_numpy()

    num_keys = of([f"{name}_keys" for name in grouping.names], replans)
    num_valid = replans["num_valid"].to_numpy()
    mass = of([f"{name}_mass" for name in grouping.names]).reshape(*shape, -1)
    kinds, names = ["group"] * len(grouping.names), list(grouping.names)
    whole = mass.sum(axis=-1)
    if grouping.ratio is not None:
        for kind, side in zip(SIDES, (grouping.ratio.numerator, grouping.ratio.denominator), strict=True):
            at = [grouping.names.index(name) for name in side]
            mass = np.concatenate([mass, mass[..., at].sum(axis=-1, keepdims=True)], axis=-1)
            num_keys = np.concatenate([num_keys, num_keys[..., at].sum(axis=-1, keepdims=True)], axis=-1)
            kinds.append(kind)
            names.append(kind)
    return Measured(
        item=item,
        selection=selection,
        labels={"kind": pl.Series(kinds), "group": pl.Series(names)},
        absent="zero",
        mass=mass,
        whole=whole,
        valid=of(["valid_mass"]).reshape(shape),
        keys=num_keys,
        uniform=(num_keys / num_valid[:, None])[:, None, None, None],
        uniform_valid=np.ones((1, 1, 1, 1)),
        row_sum=of(["row_sum"]).reshape(shape),
        num_valid=num_valid,
        env_step=arrays["env_step"],
        denoise_time=arrays["denoise_time"],
    )
