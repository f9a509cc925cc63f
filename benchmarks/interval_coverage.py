"""Coverage and power of the intervals of nominal 95 %, measured on simulated stores with a known ratio per task.

    python benchmarks/interval_coverage.py                # 2000 simulated stores of every size, some minutes
    python benchmarks/interval_coverage.py --on-disk 20   # and 20 stores that are written to disk and read back
    python benchmarks/interval_coverage.py --only families
    python benchmarks/interval_coverage.py --only remedies            # what might be done about skewed deviations
    python benchmarks/interval_coverage.py --store runs/cubes.zarr    # how related the tasks of a store are

The mean log ratios of tasks are drawn from a population with standard deviation `between`. Episodes differ from their
task by `within` (both in natural logarithms: 0.3 is 30 %), and replans drift around their episode. Coverage:

    one task           the task's ratio, by the interval of each task over its episodes
    tasks like these   the population's ratio, by the interval of that estimand over all tasks
    these tasks        the mean over exactly these tasks with endless episodes, by the interval of that estimand

The intervals are those of `aggregate.task_tables`: of the geometric mean, which texts and pictures show, and for
comparison of the arithmetic mean of the episodes' mean ratios.

Families: tasks of one family share a part of their deviation, as many per cent as the intraclass correlation says.
Deviations of families and tasks are normal, or skewed (exponential, skewness 2). Coverage of the population's ratio by
the interval of "tasks like these", whose units are the families, and by that of "independent tasks".

Power: how often a paired comparison of two runs, as `vla-attention compare` makes it, excludes 0, beside a t test over
the task means of the differences.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import polars as pl
from numpy.typing import NDArray

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import vla_attention as va
from vla_attention.analyze.statistics.intervals import (
    POSITIVE,
    EpisodeStatistic,
    estimates,
    family_error,
    geometric_mean_over_episodes,
    mean_over_episodes,
)
from vla_attention.analyze.statistics.student import student_quantile
from vla_attention.analyze.statistics.units import Estimand, Units

Values = NDArray[np.float64]
POPULATION = np.log(5.0)
NUM_REPLANS = 8


@dataclass(frozen=True)
class Case:
    """Episodes of every task, and how much tasks and episodes differ."""

    episodes: tuple[int, ...]
    between: float
    within: float

    @property
    def tasks(self) -> NDArray[np.int64]:
        """The task of every episode, (episode,)."""
        return np.repeat(np.arange(len(self.episodes)), self.episodes)

    @property
    def size(self) -> str:
        """`10 x 5`, or the numbers of episodes where tasks differ in them."""
        if len(set(self.episodes)) == 1:
            return f"{len(self.episodes)} x {self.episodes[0]}"
        return "+".join(map(str, self.episodes))


CASES = (
    Case((5,), 0.0, 0.25),
    Case((5,), 0.0, 0.6),
    Case((50,), 0.0, 0.6),
    Case((5,) * 5, 0.3, 0.25),
    Case((5,) * 5, 0.3, 0.6),
    Case((2, 3, 5, 10, 30), 0.3, 0.6),
    Case((2, 50, 50, 50, 50), 0.3, 0.6),
    Case((2, 10, 10, 10, 10), 0.3, 0.6),
    Case((2,) * 10, 0.3, 0.25),
    Case((3,) * 10, 0.3, 0.25),
    Case((5,) * 10, 0.0, 0.25),
    Case((5,) * 10, 0.1, 0.25),
    Case((5,) * 10, 0.3, 0.25),
    Case((5,) * 10, 0.3, 0.6),
    Case((5,) * 10, 1.0, 0.6),
    Case((2, 2, 3, 3, 5, 5, 10, 10, 20, 20), 0.3, 0.6),
    Case((50,) * 10, 0.3, 0.25),
    Case((5,) * 90, 0.3, 0.6),
    Case((5,) * 2, 0.3, 0.25),
    Case((5,) * 3, 0.3, 0.25),
)
#: Numbers of tasks of the families, with names: a suite's where it is one.
FAMILIES = (
    ("5 of 4", (4,) * 5),
    ("cubes: 6+3+3+3+2", (6, 3, 3, 3, 2)),
    ("10+4+1+1+1", (10, 4, 1, 1, 1)),
    ("6 of 3", (3,) * 6),
    ("libero_goal: 5 + 5 of 1", (5, 1, 1, 1, 1, 1)),
    ("libero_10: 3+2 + 5 of 1", (3, 2, 1, 1, 1, 1, 1)),
    ("10 of 3", (3,) * 10),
    ("12+6+4+2+2 + 5 of 1", (12, 6, 4, 2, 2, 1, 1, 1, 1, 1)),
    ("libero_90: 21", (27, 23, 5, 4, 4, 3, 3, 3, 2, 2, 2, 2, 2, 1, 1, 1, 1, 1, 1, 1, 1)),
)
#: Intraclass correlations of tasks in families; the last one is about that of the suite `cubes`.
CORRELATIONS = (0.0, 0.5, 0.95)
#: How deviations are distributed (skewness 0, 2 and 6.2), what is tried about it, and draws of the bootstrap.
SHAPES = ("normal", "exponential", "log-normal")
REMEDIES = ("today", "one less", "Johnson", "Hall", "bootstrap-t")
DRAWS = 399
OF_REMEDIES = ("5 of 4", "cubes: 6+3+3+3+2", "6 of 3", "10 of 3", "12+6+4+2+2 + 5 of 1")
#: Standard deviation of tasks, and of episodes in a task; episodes per task.
OF_TASKS, OF_EPISODES, EPISODES = 0.3, 0.1, 2
#: Tasks x episodes of the paired comparisons; the true difference is `EFFECT` and differs between tasks by `SPREAD`.
PAIRED = ((10, 5), (10, 10), (5, 5), (4, 4), (10, 50))
EFFECT, SPREAD, NOISE = 0.25, 0.25, 0.35


def log_ratios(case: Case, generator: np.random.Generator) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Mean log ratio of each task (task,), and log ratios (episode, replan)."""
    tasks = POPULATION + generator.normal(0, case.between, len(case.episodes))
    episodes = tasks[case.tasks] + generator.normal(0, case.within, len(case.tasks))
    # A walk whose mean over the episode is zero: replans are correlated, and the episode's mean does not change.
    walk = generator.normal(0, 0.1, (len(episodes), NUM_REPLANS)).cumsum(axis=1)
    return tasks, episodes[:, None] + walk - walk.mean(axis=1, keepdims=True)


def bounds(statistic: EpisodeStatistic, units: Units) -> tuple[float, float]:
    """The ends of one interval."""
    interval = estimates([statistic], units)[0].interval()
    assert interval is not None
    return interval.low, interval.high


def simulate(case: Case, num_stores: int, seed: int) -> dict[str, float]:
    """Share of the intervals that hold the truth, by what they are about, and the width of the one over all tasks."""
    generator = np.random.default_rng([seed, len(case.tasks), int(100 * case.between), int(100 * case.within)])
    # The arithmetic mean of log-normal ratios has another truth: exp(mu + variance / 2).
    above = case.within**2 / 2
    found: dict[str, list[float]] = {}

    def note(
        name: str, statistic: EpisodeStatistic, truth: float, estimand: Estimand, tasks: NDArray[np.int64]
    ) -> None:
        low, high = bounds(statistic, Units.of(tasks, estimand))
        found.setdefault(name, []).append(float(low <= truth <= high))
        found.setdefault(f"width {name}", []).append(float(np.log(high / low)))

    several = len(case.episodes) > 1
    for _ in range(num_stores):
        means, logs = log_ratios(case, generator)
        of_episodes, flat = logs.mean(axis=1), np.exp(logs.mean(axis=1))
        geometric, arithmetic = geometric_mean_over_episodes(of_episodes), mean_over_episodes(flat, POSITIVE)
        first = case.episodes[0]
        of_task = geometric_mean_over_episodes(of_episodes[:first])
        note("task", of_task, np.exp(means[0]), Estimand.THESE_TASKS, case.tasks[:first])
        if not several:
            note("task mean", arithmetic, np.exp(means[0] + above), Estimand.THESE_TASKS, case.tasks)
            continue
        note("like", geometric, np.exp(POPULATION), Estimand.TASKS_LIKE_THESE, case.tasks)
        note("these", geometric, np.exp(means.mean()), Estimand.THESE_TASKS, case.tasks)
        population = np.exp(POPULATION + above + case.between**2 / 2)
        note("like mean", arithmetic, population, Estimand.TASKS_LIKE_THESE, case.tasks)
        note("these mean", arithmetic, float(np.exp(means + above).mean()), Estimand.THESE_TASKS, case.tasks)
    return {name: float(np.mean(values)) for name, values in found.items()}


def deviations(shape: tuple[int, ...], skewed: bool, generator: np.random.Generator) -> NDArray[np.float64]:
    """Independent values with mean 0 and standard deviation 1: normal, or exponential (skewness 2)."""
    return generator.exponential(size=shape) - 1.0 if skewed else generator.normal(size=shape)


def with_families(
    sizes: tuple[int, ...], correlation: float, skewed: bool, num_stores: int, seed: int
) -> dict[str, tuple[float, float]]:
    """Share of the intervals that hold the population's ratio and log(high / low) in the median, by what units are."""
    generator = np.random.default_rng([seed, len(sizes), sum(sizes), int(100 * correlation), skewed])
    families = np.repeat(np.arange(len(sizes)), sizes)
    tasks = np.repeat(np.arange(len(families)), EPISODES)
    units = {"families": Units.of(tasks, families=families[tasks].astype(str)), "tasks": Units.of(tasks)}
    held: dict[str, list[bool]] = {name: [] for name in units}
    widths: dict[str, list[float]] = {name: [] for name in units}
    for _ in range(num_stores):
        own = np.sqrt(1 - correlation) * deviations(families.shape, skewed, generator)
        shared = np.sqrt(correlation) * deviations((len(sizes),), skewed, generator)[families]
        logs = POPULATION + OF_TASKS * (own + shared)[tasks] + generator.normal(0, OF_EPISODES, len(tasks))
        for name, of in units.items():
            low, high = bounds(geometric_mean_over_episodes(logs), of)
            held[name].append(low <= np.exp(POPULATION) <= high)
            widths[name].append(float(np.log(high / low)))
    return {name: (float(np.mean(held[name])), float(np.median(widths[name]))) for name in units}


def print_families(num_stores: int, seed: int) -> None:
    """The table of families."""
    print("\nFamilies: coverage in % of the population's ratio, by families of tasks and as if no two were related;")
    print(
        f"tasks differ by {OF_TASKS}, episodes by {OF_EPISODES}, {EPISODES} episodes of each task. width: the median.\n"
    )
    print("                                     deviations  intraclass   coverage         width")
    print("families                             are         correlation  families tasks   families tasks")
    for name, sizes in FAMILIES:
        for skewed in (False, True):
            for correlation in CORRELATIONS:
                found = with_families(sizes, correlation, skewed, num_stores, seed)
                (by_family, wide), (by_task, narrow) = found["families"], found["tasks"]
                print(
                    f"{name:36} {'skewed' if skewed else 'normal':11} {correlation:11.2f}  {100 * by_family:8.1f} "
                    f"{100 * by_task:5.1f}   {wide:8.2f} {narrow:5.2f}",
                    flush=True,
                )


def remedies(
    sizes: tuple[int, ...], correlation: float, shape: str, num_stores: int, seed: int
) -> dict[str, tuple[float, float]]:
    """Coverage in % of what may be done about skewed deviations, and the median width over that of today's interval.

    As `with_families`, with one mean a task instead of episodes. With S_g the sum of a family's tasks and G families:

        today          t with the degrees of freedom of Satterthwaite
        one less       the same with one degree of freedom less, at least one
        Johnson, Hall  today's, from a t that is corrected for the third moment of the S_g: Johnson 1978 (Journal of the
                       American Statistical Association 73), and the cubic transformation of Hall 1992 (Journal of the
                       Royal Statistical Society B 54), both inverted
        bootstrap-t    families drawn with replacement, `DRAWS` times (Efron & Tibshirani 1993, chapter 12; Hall 1988)
    """
    generator = np.random.default_rng([seed, len(sizes), sum(sizes), int(100 * correlation), SHAPES.index(shape)])
    size = np.array(sizes, dtype=np.float64)
    families, num_families = np.repeat(np.arange(len(sizes)), sizes), len(sizes)
    own = np.sqrt(1 - correlation) * shaped((num_stores, len(families)), shape, generator)
    shared = np.sqrt(correlation) * shaped((num_stores, num_families), shape, generator)
    values = own + shared[:, families]  # (store, task); the truth is 0
    sums = values @ (families[:, None] == np.arange(num_families))
    mean = values.mean(axis=1)
    variance, degrees = family_error(values - mean[:, None], np.ones_like(values, bool), families, 2)
    error = np.sqrt(variance)

    def quantile(less: float) -> NDArray[np.float64]:
        return np.array([student_quantile(0.95, max(1.0, one - less)) for one in degrees])

    today = quantile(0.0) * error
    bounds = {"today": (mean - today, mean + today)}
    wider = quantile(1.0) * error
    bounds["one less"] = mean - wider, mean + wider
    apart = sums - size * mean[:, None]
    skewness = (apart**3).mean(axis=1) / ((apart**2).mean(axis=1)) ** 1.5
    root = np.sqrt(num_families)
    moved = skewness * error / root * (1 / 6 + (quantile(0.0) ** 2) / 3)
    bounds["Johnson"] = mean + moved - today, mean + moved + today
    ends = []
    for sign in (1.0, -1.0):
        x, a = sign * quantile(0.0), skewness / root
        with np.errstate(divide="ignore", invalid="ignore"):
            t = 3 * (np.cbrt(1 + a * (x - a / 6)) - 1) / a
        ends.append(mean - np.where(np.abs(a) < 1e-9, x, t) * error)
    bounds["Hall"] = np.minimum(*ends), np.maximum(*ends)
    drawn = generator.integers(0, num_families, (DRAWS, num_families))
    of_draw = np.stack([_student_of_draws(one, size, drawn) for one in sums - size * mean[:, None]])
    low, high = np.quantile(of_draw, (0.025, 0.975), axis=1)
    bounds["bootstrap-t"] = mean - high * error, mean - low * error
    width = 2 * today
    return {
        name: (100 * float(((low <= 0) & (high >= 0)).mean()), float(np.median((high - low) / width)))
        for name, (low, high) in bounds.items()
    }


def _student_of_draws(apart: Values, size: Values, drawn: NDArray[np.int64]) -> Values:
    """Student's t of every draw of families (draw, family), of the sums of their deviations (family,)."""
    sums, sizes = apart[drawn], size[drawn]
    num_tasks = sizes.sum(axis=1, keepdims=True)
    mean = sums.sum(axis=1, keepdims=True) / num_tasks
    with np.errstate(divide="ignore", invalid="ignore"):
        variance = ((sums - sizes * mean) ** 2 / (num_tasks * (num_tasks - sizes))).sum(axis=1)
        t = mean[:, 0] / np.sqrt(variance)
    return np.where(np.isnan(t), 0.0, t)


def shaped(shape: tuple[int, ...], kind: str, generator: np.random.Generator) -> Values:
    """Independent values with mean 0 and standard deviation 1."""
    if kind == "log-normal":
        made = np.exp(generator.normal(size=shape))
        return (made - np.exp(0.5)) / np.sqrt((np.e - 1) * np.e)
    return deviations(shape, kind == "exponential", generator)


def print_remedies(num_stores: int, seed: int) -> None:
    """The table of remedies."""
    print("\nWhat may be done about few families of skewed deviations: coverage in %, and width / today's width\n")
    print(f"| families | deviations | intraclass correlation | {' | '.join(REMEDIES)} |")
    print("|---|---|---|" + "---|" * len(REMEDIES))
    for name, sizes in FAMILIES:
        if name not in OF_REMEDIES:
            continue
        for shape in SHAPES:
            for correlation in (0.0, 0.95):
                found = remedies(sizes, correlation, shape, num_stores, seed)
                cells = [f"{found[one][0]:.1f} ({found[one][1]:.2f})" for one in REMEDIES]
                print(f"| {name} | {shape} | {correlation} | {' | '.join(cells)} |", flush=True)


def intraclass_correlation(values: NDArray[np.float64], families: NDArray[np.intp]) -> float:
    """Of values (task,) in families (task,): (between - within) / (between + (n0 - 1) within), by analysis of variance.

    With mean squares between and within families and n0 = (T - sum n_g^2 / T) / (G - 1) (Donner 1986, International
    Statistical Review 54).
    """
    size = np.bincount(families)
    means = np.bincount(families, values) / size
    between = (size * (means - values.mean()) ** 2).sum() / (len(size) - 1)
    within = ((values - means[families]) ** 2).sum() / (len(values) - len(size))
    usual = (len(values) - (size**2).sum() / len(values)) / (len(size) - 1)
    return float((between - within) / (between + (usual - 1) * within))


def print_store(path: Path) -> None:
    """How related the tasks of a store are in their log ratios, and its three intervals."""
    run = va.open(path)
    families = dict(run.episodes.select("task_id", "task_family").iter_rows())
    ratios = run.analyze()["episodes"].filter(layer="layers_avg")
    means = ratios.group_by("task_id").agg(pl.col("log_ratio_mean").mean()).sort("task_id")
    names = np.unique([families[task] for task in means["task_id"]], return_inverse=True)[1]
    found = intraclass_correlation(means["log_ratio_mean"].to_numpy(), names)
    print(f"{path}: {means.height} tasks of {names.max() + 1} families, intraclass correlation {found:.2f}")
    for estimand in Estimand:
        row = run.analyze(intervals=estimand)["tasks"].filter(scope="all", layer="layers_avg").row(0, named=True)
        numbers = [row[f"geometric_mean{end}"] for end in ("", "_low", "_high")]
        print("  {:18} {:.3f} [{:.3f}, {:.3f}]".format(estimand.value, *numbers))


def power(num_tasks: int, num_episodes: int, num_stores: int, seed: int, effect: float) -> tuple[float, float]:
    """How often 0 is excluded: by the interval of a paired comparison, and by a t test over task means."""
    generator = np.random.default_rng([seed, num_tasks, num_episodes])
    tasks = np.repeat(np.arange(num_tasks), num_episodes)
    ours = theirs = 0
    for _ in range(num_stores):
        differences = effect + generator.normal(0, SPREAD, num_tasks)[tasks] + generator.normal(0, NOISE, len(tasks))
        low, high = bounds(mean_over_episodes(differences), Units.of(tasks))
        ours += not low <= 0 <= high
        means = differences.reshape(num_tasks, num_episodes).mean(axis=1)
        t = means.mean() / (means.std(ddof=1) / np.sqrt(num_tasks))
        theirs += abs(t) > student_quantile(0.95, num_tasks - 1)
    return ours / num_stores, theirs / num_stores


def through_files(case: Case, num_stores: int, seed: int) -> dict[str, float]:
    """The same with stores on disk: written by the real writer, read back and analysed."""
    from tests.kit.stores import StoreSpec, write_store
    from vla_attention.analyze.commands.analyze import analyze
    from vla_attention.analyze.measures.question import ask
    from vla_attention.analyze.measures.question_settings import AnalysisSettings
    from vla_attention.schemas.layout import Role
    from vla_attention.schemas.stores.reader import open_store

    generator = np.random.default_rng([seed, 1])
    num_tasks, num_episodes = len(case.episodes), case.episodes[0]
    found: dict[str, list[float]] = {}
    for _ in range(num_stores):
        means, logs = log_ratios(case, generator)

        def plant(task: int, episode: int, tokens, rows, logs=logs):  # type: ignore[no-untyped-def]
            visual = tokens.key_role == Role.IMAGE
            linguistic = np.isin(tokens.key_role, [int(Role.INSTRUCTION), int(Role.BOS)])
            share = 1 / (1 + np.exp(-logs[task * num_episodes + episode]))[:, None]
            weight = share * visual / visual.sum(axis=1, keepdims=True)
            weight = weight + (1 - share) * linguistic / linguistic.sum(axis=1, keepdims=True)
            return np.broadcast_to(weight[:, None, None, None, None, :], rows.shape)

        spec = StoreSpec(
            tasks=tuple(range(num_tasks)),
            episodes=num_episodes,
            replans=NUM_REPLANS,
            plant_rows=plant,
            layers=(0,),
            heads=(0,),
            denoise_steps=(9,),
            frames=False,
            coverage=False,
        )
        with tempfile.TemporaryDirectory() as folder:
            store = open_store(write_store(Path(folder) / "simulated.zarr", spec=spec))
            for name, estimand, truth in (
                ("like", Estimand.TASKS_LIKE_THESE, np.exp(POPULATION)),
                ("these", Estimand.THESE_TASKS, np.exp(means.mean())),
            ):
                cells = analyze(ask([store], AnalysisSettings(intervals=estimand)))["tasks"]
                row = cells.filter(pl.col("layer") == "0", pl.col("scope") == "all").row(0, named=True)
                held = row["geometric_mean_low"] <= truth <= row["geometric_mean_high"]
                found.setdefault(name, []).append(float(held))
    return {name: float(np.mean(values)) for name, values in found.items()}


def line(case: Case, found: dict[str, float]) -> str:
    """One case as a line of the table."""
    cells = [f"{case.size:26}", f"{case.between:5.1f}", f"{case.within:7.2f}"]
    for name in ("task", "like", "these"):
        for kind in ("", " mean"):
            share = found.get(f"{name}{kind}")
            cells.append("      -" if share is None else f"{100 * share:7.1f}")
    cells += [f"{found[f'width {name}']:7.2f}" if f"width {name}" in found else "      -" for name in ("like", "these")]
    return " ".join(cells)


def main() -> None:
    parser = argparse.ArgumentParser(description="Coverage and power of the intervals of nominal 95 %.")
    parser.add_argument("--stores", type=int, default=2000, help="simulated stores of every size (default: 2000)")
    parser.add_argument("--on-disk", type=int, default=0, metavar="N", help="also N stores of 10 x 5 through files")
    parser.add_argument("--only", choices=("tasks", "families", "remedies"), help="one of the tables (default: all)")
    parser.add_argument("--store", type=Path, help="instead: the intraclass correlation and the intervals of a store")
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    if arguments.store is not None:
        print_store(arguments.store)
        return
    if arguments.only == "families":
        print_families(arguments.stores, arguments.seed)
        return
    if arguments.only == "remedies":
        print_remedies(arguments.stores, arguments.seed)
        return
    error = 100 * np.sqrt(0.95 * 0.05 / max(1, arguments.stores))
    print(f"Coverage in % of intervals of nominal 95 %, {arguments.stores} stores of each size, error {error:.1f}.")
    print(
        "geo: of the geometric mean, which is printed; mean: of the arithmetic mean. width: log(high / low) of geo.\n"
    )
    print("                           differences of      one task  tasks like these    these tasks   width of geo")
    print("tasks x episodes           tasks episodes  geo    mean     geo    mean     geo    mean    like   these")
    for case in CASES if arguments.stores else ():
        print(line(case, simulate(case, arguments.stores, arguments.seed)), flush=True)
    if arguments.stores and not arguments.only:
        print_families(arguments.stores, arguments.seed)
    if arguments.stores:
        print(f"\nPaired comparisons that exclude 0, in % (difference {EFFECT}, between tasks {SPREAD}, noise {NOISE})")
        print("tasks x episodes   interval  t test over task means   without a difference")
    for num_tasks, num_episodes in PAIRED if arguments.stores else ():
        ours, theirs = power(num_tasks, num_episodes, arguments.stores, arguments.seed, EFFECT)
        null, _ = power(num_tasks, num_episodes, arguments.stores, arguments.seed, 0.0)
        print(
            f"{num_tasks:5d} x {num_episodes:<4d} {100 * ours:14.1f} {100 * theirs:15.1f} {100 * null:24.1f}",
            flush=True,
        )
    if arguments.on_disk:
        print(f"\nthe same through {arguments.on_disk} stores on disk of 10 x 5")
        print(line(CASES[12], through_files(CASES[12], arguments.on_disk, arguments.seed)))


if __name__ == "__main__":
    main()
