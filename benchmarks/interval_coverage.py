"""Coverage of intervals of nominal 95 %, measured on simulated stores with a known ratio per task.

    python benchmarks/interval_coverage.py                # 500 simulated stores of every size, about ten minutes
    python benchmarks/interval_coverage.py --on-disk 20   # and 20 stores that are written to disk and read back

The mean log ratios of tasks are drawn from a population with standard deviation `between`. Episodes differ from their
task by `within` (both in natural logarithms: 0.3 is 30 %), and replans drift around their episode. Coverage of three
truths is measured:

    the task's ratio          by the interval of each task, over its episodes
    the population's ratio    by the two-level interval over all tasks: the ratio of tasks like these
    these tasks' ratio        by the same interval: the mean over exactly these tasks, with endless episodes

The intervals are those of `aggregate.task_tables`, column `geometric_mean`, as they are and as plain percentile
intervals.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path
from unittest import mock

import numpy as np
import polars as pl
from numpy.typing import NDArray

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from tests.kit import made_up_steps
from vla_attention.analyze.measures import aggregate
from vla_attention.analyze.measures.frames import Tables
from vla_attention.analyze.statistics import bootstrap
from vla_attention.schemas.groupings.grouping import Grouping, Ratio

GROUPING = Grouping(
    "two", {"visual": ("role:image",), "linguistic": ("role:instruction",)}, Ratio(("visual",), ("linguistic",))
)
POPULATION = np.log(5.0)
NUM_REPLANS = 8
NUM_RESAMPLES = 2000


@dataclass(frozen=True)
class Case:
    """A size of store and how much its tasks and episodes differ."""

    num_tasks: int
    num_episodes: int
    between: float
    within: float


CASES = (
    Case(10, 5, 0.3, 0.25),
    Case(10, 5, 0.1, 0.25),
    Case(10, 5, 0.0, 0.25),
    Case(10, 5, 0.3, 0.6),
    Case(10, 3, 0.3, 0.25),
    Case(10, 10, 0.3, 0.25),
    Case(10, 50, 0.3, 0.25),
    Case(5, 5, 0.3, 0.25),
    Case(3, 5, 0.3, 0.25),
    Case(2, 5, 0.3, 0.25),
    Case(90, 5, 0.3, 0.25),
)


def log_ratios(case: Case, generator: np.random.Generator) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Mean log ratio of each task (task,), and log ratios (task, episode, replan)."""
    tasks = POPULATION + generator.normal(0, case.between, case.num_tasks)
    shape = (case.num_tasks, case.num_episodes, NUM_REPLANS)
    episodes = tasks[:, None] + generator.normal(0, case.within, shape[:2])
    # A walk whose mean over the episode is zero: replans are correlated, and the episode's mean does not change.
    walk = generator.normal(0, 0.1, shape).cumsum(axis=2)
    return tasks, episodes[:, :, None] + walk - walk.mean(axis=2, keepdims=True)


def replans_of(logs: NDArray[np.float64]) -> Tables:
    """Tables as `aggregate.replan_tables` gives them, of one layer, from log ratios (task, episode, replan)."""
    task, episode, replan = (part.ravel() for part in np.indices(logs.shape))
    visual = 1 / (1 + np.exp(-logs.ravel()))
    keys = {"visual": 512.0, "linguistic": 12.0}
    columns: dict[str, object] = {
        "suite": ["simulated"] * logs.size,
        "task_id": task,
        "instruction": [""] * logs.size,
        "episode_index": episode,
        "success": [True] * logs.size,
        "num_steps": np.full(logs.size, 5 * NUM_REPLANS),
        "replan": replan,
        "env_step": 10 + 5 * replan,
        "layer": np.zeros(logs.size, dtype=np.int64),
        "block": np.zeros(logs.size, dtype=np.int64),
        "denoise_step": np.full(logs.size, 9),
        "denoise_time": np.full(logs.size, 0.1),
        "head": pl.Series([None] * logs.size, dtype=pl.Int64),
        "row_sum": np.ones(logs.size),
        "valid_mass": np.ones(logs.size),
        "num_valid": np.full(logs.size, 524),
        "visual_mass": visual,
        "linguistic_mass": 1 - visual,
    }
    columns |= {f"{name}_keys": np.full(logs.size, count) for name, count in keys.items()}
    return made_up_steps.replans_of(pl.DataFrame(columns), GROUPING)


def tables(replans: Tables, seed: int) -> dict[str, pl.DataFrame]:
    """`aggregate.task_tables` with the intervals of this program, and with plain percentile intervals."""
    episodes = aggregate.episode_tables(replans, GROUPING)
    with mock.patch.object(bootstrap, "widening", return_value=1.0):
        percentile = aggregate.task_tables(episodes, GROUPING, NUM_RESAMPLES, seed=seed)
    widened = aggregate.task_tables(episodes, GROUPING, NUM_RESAMPLES, seed=seed)
    return {"widened": widened.cells, "percentile": percentile.cells}


def hits(table: pl.DataFrame, tasks: NDArray[np.float64]) -> dict[str, float]:
    """Share of the intervals that hold each truth."""
    table = table.filter(pl.col("layer") == "0")
    of_tasks = table.filter(pl.col("scope") == "task").sort("task_id")
    low, high = (of_tasks[f"geometric_mean_{end}"].to_numpy() for end in ("low", "high"))
    inside = (low <= np.exp(tasks)) & (np.exp(tasks) <= high)
    whole = table.filter(pl.col("scope") == "all").row(0, named=True)
    bounds = (whole["geometric_mean_low"], whole["geometric_mean_high"])
    return {
        "task": float(inside.mean()),
        "population": float(bounds[0] <= np.exp(POPULATION) <= bounds[1]),
        "these tasks": float(bounds[0] <= np.exp(tasks.mean()) <= bounds[1]),
        "width": float(np.log(bounds[1] / bounds[0])),
    }


def simulate(case: Case, num_stores: int, seed: int) -> dict[tuple[str, str], float]:
    """Mean of `hits` over simulated stores, by (interval, truth)."""
    generator = np.random.default_rng(
        [seed, case.num_tasks, case.num_episodes, int(100 * case.between), int(100 * case.within)]
    )
    found: dict[tuple[str, str], list[float]] = {}
    for store in range(num_stores):
        tasks, logs = log_ratios(case, generator)
        for kind, table in tables(replans_of(logs), seed=store).items():
            for truth, share in hits(table, tasks).items():
                found.setdefault((kind, truth), []).append(share)
    return {key: float(np.mean(values)) for key, values in found.items()}


def through_files(case: Case, num_stores: int, seed: int) -> dict[tuple[str, str], float]:
    """The same with stores on disk: written by the real writer, read back and analysed."""
    from vla_attention.analyze.measures.question import ask
    from vla_attention.analyze.measures.question_settings import AnalysisSettings
    from vla_attention.analyze.ratios.analysis import analyse
    from vla_attention.schemas.layout import Role
    from vla_attention.schemas.stores.reader import open_store
    from vla_attention.testing.stores import StoreSpec, write_store

    generator = np.random.default_rng([seed, 1])
    found: dict[tuple[str, str], list[float]] = {}
    for number in range(num_stores):
        tasks, logs = log_ratios(case, generator)

        def plant(task: int, episode: int, tokens, rows, logs=logs):  # type: ignore[no-untyped-def]
            visual = tokens.key_role == Role.IMAGE
            linguistic = np.isin(tokens.key_role, [int(Role.INSTRUCTION), int(Role.BOS)])
            share = 1 / (1 + np.exp(-logs[task, episode]))[:, None]
            weight = share * visual / visual.sum(axis=1, keepdims=True)
            weight = weight + (1 - share) * linguistic / linguistic.sum(axis=1, keepdims=True)
            return np.broadcast_to(weight[:, None, None, None, None, :], rows.shape)

        spec = StoreSpec(
            tasks=tuple(range(case.num_tasks)), episodes=case.num_episodes, replans=NUM_REPLANS, plant_rows=plant
        )
        spec = StoreSpec(
            **{**vars(spec), "layers": (0,), "heads": (0,), "denoise_steps": (9,), "frames": False, "coverage": False}
        )
        with tempfile.TemporaryDirectory() as folder:
            store = open_store(write_store(Path(folder) / "simulated.zarr", spec=spec))
            analysis = analyse(ask([store], AnalysisSettings(seed=number)))
        for truth, share in hits(analysis.tasks.cells, tasks).items():
            found.setdefault(("widened", truth), []).append(share)
    return {key: float(np.mean(values)) for key, values in found.items()}


def line(case: Case, found: dict[tuple[str, str], float]) -> str:
    cells = [f"{case.num_tasks:5d} x {case.num_episodes:<4d}", f"{case.between:7.2f}", f"{case.within:7.2f}"]
    for truth in ("task", "population", "these tasks"):
        keys = [(kind, truth) for kind in ("percentile", "widened")]
        cells += [f"{100 * found[key]:7.1f}" if key in found else "      -" for key in keys]
    return " ".join([*cells, f"{found['widened', 'width']:8.2f}"])


def main() -> None:
    parser = argparse.ArgumentParser(description="Coverage of the intervals of nominal 95 %.")
    parser.add_argument("--stores", type=int, default=500, help="simulated stores of every size (default: 500)")
    parser.add_argument("--on-disk", type=int, default=0, metavar="N", help="also N stores of 10 x 5 through files")
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    # Per-task coverage is a mean over stores and tasks; overall coverage is one hit or miss per store.
    error = 100 * np.sqrt(0.95 * 0.05 / max(1, arguments.stores))
    print(f"Coverage in % of intervals of nominal 95 %, {arguments.stores} stores of each size.")
    print(f"The standard error is {error:.1f} overall. p: plain percentile interval; w: widened as in")
    print("vla_attention.analyze.statistics.small_samples; width: mean of log(high / low), widened.\n")
    print("                  differences of     one task       population     these tasks")
    print("tasks x episodes tasks episodes      p       w       p       w       p       w    width")
    for case in CASES if arguments.stores else ():
        print(line(case, simulate(case, arguments.stores, arguments.seed)), flush=True)
    if arguments.on_disk:
        print(f"\nthe same through {arguments.on_disk} stores on disk")
        print(line(CASES[0], through_files(CASES[0], arguments.on_disk, arguments.seed)))


if __name__ == "__main__":
    main()
