"""How often the commands name something in stores in which there is nothing to name.

    python benchmarks/null_stores.py                  # 200 stores of each kind, some minutes
    python benchmarks/null_stores.py --planted        # the same with something to find

In a null store every key's attention is the same in expectation; tasks, episodes and keys scatter around it. The nulls:

    analyze   neither pictures nor text get more attention per token
    words     every word has the same lift in every layer and head
    compare   two runs of the same distribution, paired by initial state
    language  what is done has nothing to do with what is told (rollouts without attention: seconds)
    effects   the action changes as much without each word, part and picture as with another noise seed

A planted store differs in one place: the attention to the pictures, to the word "the", or of the second run, is higher,
by `FACTOR` or a power of it. `null_objects.py` has the nulls of `objects`.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections.abc import Callable
from contextlib import redirect_stdout
from dataclasses import replace
from io import StringIO
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import vla_attention as va
from tests.kit.made_up_behaviour import STEPS, did, goals_of
from tests.kit.planted_effects import FIRST, planted_effects
from tests.kit.stores import StoreSpec, write_store
from vla_attention.analyze.commands.language import SHOWN_AT, listens
from vla_attention.analyze.core.behaviour import with_choices
from vla_attention.schemas.groupings.vocabulary import EpisodeTokens
from vla_attention.schemas.layout import Role

TASKS, EPISODES, REPLANS = 5, 4, 6
FACTOR = 4 / 3
#: Of a q-value and of an interval.
LEVEL = 0.05

Rows = NDArray[np.float64]


def scattered(generator: np.random.Generator, rows: Rows) -> Rows:
    """Rows (replan, layer, denoise, head, query, key) with noise of every key, layer and head, and of every replan."""
    keys = generator.normal(0, 0.3, (1, rows.shape[1], 1, rows.shape[3], 1, rows.shape[5]))
    noisy: Rows = np.where(rows > 0, np.exp(keys + generator.normal(0, 0.2, rows.shape)), 0.0)
    return noisy


def normalised(rows: Rows) -> Rows:
    """Rows that sum to 1."""
    whole: Rows = rows / rows.sum(axis=-1, keepdims=True)
    return whole


def plant_of(kind: str, seed: int, planted: bool) -> Callable[[int, int, EpisodeTokens, Rows], Rows]:
    """The rows of one store."""

    def plant(task: int, episode: int, tokens: EpisodeTokens, rows: Rows) -> Rows:
        # Tasks differ too, which is noise about tasks like these; both runs of a comparison share it.
        of_task = np.random.default_rng([seed // 2, task, 10**6]).normal(0, 0.15, rows.shape[-1])
        made = scattered(np.random.default_rng([seed, task, episode]), rows) * np.exp(of_task)
        factor = np.ones((len(made), made.shape[-1]))
        image = tokens.key_role == Role.IMAGE
        if kind == "words":
            assert tokens.prompt_index is not None
            for piece in tokens.prompts[tokens.prompt_index[0]].pieces:
                if piece.text.strip() == "the":
                    factor[:, piece.key] = FACTOR**4
        elif kind == "analyze" or seed % 2:  # compare: the second run
            factor = np.where(image, FACTOR, 1.0)
        return normalised(made * (factor[:, None, None, None, None, :] if planted else 1.0))

    return plant


SPEC = StoreSpec(
    tasks=tuple(range(TASKS)),
    episodes=EPISODES,
    replans=REPLANS,
    layers=(0, 1, 2),
    heads=(0, 1),
    denoise_steps=(9,),
    plant_success=lambda task, episode: episode % 2 == 0,
    prompts="same",
    # Unrelated tasks, though some have the same instruction.
    task_families={task: f"template {task}" for task in range(TASKS)},
)


def names_something(kind: str, number: int, planted: bool, folder: Path) -> bool:
    """Whether a sentence of the first screen about one store, or about two, names something; read from its numbers."""
    spec = replace(SPEC, frames=False, coverage=kind == "compare", mantissa_bits=23, seed=number)
    paths = []
    for run in range(2 if kind == "compare" else 1):
        own = replace(spec, plant_rows=plant_of(kind, 2 * number + run, planted))
        paths.append(write_store(folder / f"run{run}.zarr", spec=own))
    store = va.open(paths[0])
    if kind == "words":
        return "word" in store.words().findings[0].numbers
    if kind == "analyze":
        numbers = store.analyze().findings[0].numbers
        return not float(numbers["ratio_lift_low"]) <= 1 <= float(numbers["ratio_lift_high"])
    *behaved, attention = (finding.numbers for finding in store.compare(paths[1]).findings)
    tests = [float(p) for numbers in behaved for name, p in numbers.items() if name.split("_")[0] == "p"]
    return min(tests, default=1.0) <= LEVEL or any(attention.values())


def says_it_listens(sets: int, planted: bool) -> float:
    """The share of sets of rollouts of which `language` says that what was told was done more often than by chance.

    In a null set the goals that a policy reaches, and when, are drawn without a look at what it was told; it reaches
    some goals more readily than others. Rollouts end with their own goal, so what is seen depends on it. In a planted
    set every second rollout goes to the told goal first.
    """
    said = 0
    for number in range(sets):
        generator = np.random.default_rng(number)
        tasks, episodes = generator.integers(2, 5), generator.integers(4, 9)
        goals = goals_of({task: f"touch cube {task}" for task in range(tasks)})
        liked = generator.uniform(0, 1, tasks)
        rollouts = []
        for told in np.repeat(np.arange(tasks), episodes).tolist():
            moments = {
                task: int(generator.integers(1, STEPS)) for task in range(tasks) if generator.random() < liked[task]
            }
            if planted and generator.random() < FACTOR / 2:
                moments[told] = 1
            rollouts.append((told, moments))
        p = listens(with_choices(did(rollouts, goals, "touch cube N"))).numbers.get("p")
        said += p is not None and float(p) <= SHOWN_AT
    return said / sets


#: What `effects` may name: the question of a finding -> the numbers that are counts of named items.
EFFECT_SENTENCES = {
    "Does it tell words apart?": (),
    "What if a word is left out?": ("shown",),
    "And without something else?": ("shown", "gripper", "smaller"),
    "How do these words reach the action?": (),
    "Does attention tell?": (),
}


def named_by_effects(number: int, planted: float, folder: Path, tasks: int = 6, episodes: int = 3) -> set[str]:
    """The findings of `effects` that name something in a store whose actions change as much without each word, part and
    picture, and with each word exchanged, as with another noise seed.

    Tasks and episodes scatter, each item scatters by tasks, and replans scatter. In a planted store the first word
    changes the action by `planted` times as much more.
    """
    generator = np.random.default_rng(number)
    scene, of_item = generator.normal(0, 0.2, (tasks, episodes)), dict[str, Rows]()

    def scale(name: str, task: int, episode: int, replan: int) -> float:
        del replan
        own = of_item.setdefault(name, generator.normal(0, 0.15, tasks))
        size = float(np.exp(scene[task, episode] + own[task] + generator.normal(0, 0.2)))
        return size * (1 + planted * (FIRST in name))

    plant = planted_effects(scale, alike=0.3, exchanged=True)
    spec = StoreSpec(tasks=tuple(range(tasks)), episodes=episodes, replans=2, layers=(0,), heads=(0,), frames=False,
                     coverage=False, plant_effects=plant, seed=number)  # fmt: skip
    found = va.open(write_store(folder / "a.zarr", spec=spec)).effects()
    named = set()
    for finding in found.findings:
        counts = EFFECT_SENTENCES.get(finding.asks)
        by_count = counts and any(int(finding.numbers[name]) for name in counts)
        if by_count or (counts == () and not (finding.asks == "Does it tell words apart?" and finding.limit)):
            named.add(finding.asks)
    return named


def main() -> None:
    """Print a line per command."""
    parser = argparse.ArgumentParser(description="How often commands name something in null stores.")
    parser.add_argument("--stores", type=int, default=200, help="stores of each kind (default: 200)")
    parser.add_argument("--planted", action="store_true", help="with something to find")
    kinds = ["analyze", "words", "compare", "language", "effects"]
    parser.add_argument("--kinds", nargs="+", default=kinds)
    arguments = parser.parse_args()
    what = "planted" if arguments.planted else "null"
    print(f"{arguments.stores} {what} stores of {TASKS} tasks x {EPISODES} episodes x {REPLANS} replans each:")
    for kind in arguments.kinds:
        if kind == "language":
            share = says_it_listens(arguments.stores, arguments.planted)
            print(f"  {kind:8} says that it listens in {share:.1%}", flush=True)
            continue
        if kind == "effects":
            every = []
            for number in range(arguments.stores):
                with tempfile.TemporaryDirectory() as folder, redirect_stdout(StringIO()):
                    every.append(named_by_effects(number, 0.8 * arguments.planted, Path(folder)))
            print(f"  {kind:8} names something in {sum(map(bool, every)) / len(every):.1%}", flush=True)
            for asks in EFFECT_SENTENCES:
                print(f"           {asks:40} {sum(asks in named for named in every) / len(every):.1%}", flush=True)
            continue
        named = 0
        for number in range(arguments.stores):
            with tempfile.TemporaryDirectory() as folder:
                named += names_something(kind, number, arguments.planted, Path(folder))
        print(f"  {kind:8} names something in {named:4d} ({100 * named / arguments.stores:.1f} %)", flush=True)


if __name__ == "__main__":
    main()
