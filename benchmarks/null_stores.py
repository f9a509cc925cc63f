"""How often the commands name something in stores in which there is nothing to name.

    python benchmarks/null_stores.py                  # 200 stores of each kind, some minutes
    python benchmarks/null_stores.py --planted        # the same with something to find

In a null store every key's attention is the same in expectation; tasks, episodes and keys scatter around it. The nulls:

    analyze   neither pictures nor text get more attention per token
    outcome   (analyze --by outcome) attention does not depend on whether an episode is solved
    time      (analyze --by time) nor on whether something was touched already
    words     every word has the same lift in every layer and head; "words here": tasks do not differ, and sentences
              about these tasks count too
    compare   two runs of the same distribution, paired by initial state
    language  what is done has nothing to do with what is told (rollouts without attention: seconds)
    language_test  policies whose actions scatter, drift or round, whatever they are told (calls: seconds)
    effects   the action changes as much without each word, part and picture as with another noise seed
    map_order the order of a map by first order has nothing to do with the exact sizes of the patches drawn at random

A planted store differs in one place: the attention to the pictures, to the word "the", or of the second run, is higher,
by `FACTOR` or a power of it. `null_objects.py` has the nulls of `objects`.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import sys
import tempfile
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import polars as pl
from numpy.typing import NDArray

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import vla_attention as va
from tests.kit.made_up_behaviour import STEPS, did, goals_of
from tests.kit.planted_effects import planted_effects, planted_map
from tests.kit.stores import StoreSpec, small_steps, write_store
from vla_attention.analyze.commands.compare import NAMED_KINDS
from vla_attention.analyze.core.behaviour import with_choices
from vla_attention.analyze.core.listening import IN_PART, LISTENS_TO_ALL, listens
from vla_attention.analyze.core.patch_maps import TRUSTED
from vla_attention.analyze.statistics.many_looks import SHOWN_AT
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
        scatter = 0.0 if kind == "words here" else 0.15
        of_task = np.random.default_rng([seed // 2, task, 10**6]).normal(0, scatter, rows.shape[-1])
        made = scattered(np.random.default_rng([seed, task, episode]), rows) * np.exp(of_task)
        factor = np.ones((len(made), made.shape[-1]))
        image = tokens.key_role == Role.IMAGE
        if kind.startswith("words"):
            assert tokens.prompt_index is not None
            for piece in tokens.prompts[tokens.prompt_index[0]].pieces:
                if piece.text.strip() == "the":
                    factor[:, piece.key] = FACTOR**4
        elif kind == "outcome":
            factor = np.where(image & (episode % 2 == 0), FACTOR, 1.0) * factor
        elif kind == "time":
            factor[len(made) // 2 :] = np.where(image[0] if image.ndim > 1 else image, FACTOR, 1.0)
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
    steps = small_steps if kind == "time" else None
    spec = replace(SPEC, plant_steps=steps, frames=False, coverage=kind == "compare", mantissa_bits=23, seed=number)
    paths = []
    for run in range(2 if kind == "compare" else 1):
        own = replace(spec, plant_rows=plant_of(kind, 2 * number + run, planted))
        paths.append(write_store(folder / f"run{run}.zarr", spec=own))
    store = va.open(paths[0])
    if kind.startswith("words"):
        numbers = store.words().findings[0].numbers
        # Where tasks differ, a word of one of them may well be read more in it.
        return bool(numbers.get("like_these")) or (kind == "words here" and bool(numbers.get("these")))
    if kind in ("outcome", "time"):
        return bool(store.analyze(by=kind).findings[0].numbers["shown"])
    if kind == "analyze":
        numbers = store.analyze().findings[0].numbers
        return not float(numbers["ratio_lift_low"]) <= 1 <= float(numbers["ratio_lift_high"])
    numbers = {finding.asks: finding.numbers for finding in store.compare(paths[1]).findings}
    attention, looks = numbers.pop("And the attention?"), numbers.pop("Do they look for what is named?", {})
    tests = [float(p) for of in numbers.values() for name, p in of.items() if name.split("_")[0] == "p"]
    named = [
        float(q) <= LEVEL / NAMED_KINDS for name, q in looks.items() if name.endswith("_ratio_q") and q is not None
    ]
    return min(tests, default=1.0) <= LEVEL or any(attention.values()) or any(named)


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


COLOURS = ("red", "green", "blue")
SENTENCES = [*(f"touch the {colour} cube" for colour in COLOURS), *(f"lift the {colour} cube" for colour in COLOURS)]
TOUCH, LIFT = "touch the COLOUR cube", "lift the COLOUR cube"
#: Policies that hear a part of what they are told, or all of it in most episodes.
PARTLY_DEAF = ("pictures", "deaf to lift", "hears red", "obeys mostly")


def of_a_listener(policy: str, sets: int) -> dict[str, float]:
    """How often `language` is wrong about a policy that hears a part of what it is told, and how often it says which.

    pictures      does what the picture says: half of the states belong to one task each, the rest to all
    deaf to lift  touches what it is told to, and lifts what it likes in that state
    hears red     goes to red when told so, else to green in every second set, to green or blue in the others
    obeys mostly  does what it is told in 80 % of all episodes, else goes where it likes in that state

    Returns:
        wrong: "it listens" without saying to what, or what is not heard said to be heard, or what is heard not to be.
        found: what is heard is named, and nothing else; of a policy that is deaf to a kind of sentence also that.
    """
    wrong = found = 0
    for number in range(sets):
        numbers = listens(with_choices(rollouts_of(policy, np.random.default_rng(number)))).numbers
        heard, deaf = (str(numbers.get(name, "")).split(", ") for name in ("heard", "not_heard"))
        says = numbers["verdict"]
        if policy == "pictures":
            wrong += says in (LISTENS_TO_ALL, IN_PART)
        elif policy == "deaf to lift":
            wrong += says == LISTENS_TO_ALL or LIFT in heard or TOUCH in deaf
            found += TOUCH in heard and LIFT in deaf
        elif policy == "hears red":
            wrong += says == LISTENS_TO_ALL or "green" in heard or "blue" in heard or "red" in deaf
            found += heard == ["red"]
        else:
            wrong += deaf != [""]
            found += says == LISTENS_TO_ALL
    return {"wrong": wrong / sets, "found": found / sets}


def rollouts_of(policy: str, generator: np.random.Generator) -> pl.DataFrame:
    """The rows of `behaviour` of 4 to 12 initial states, in each of which every task is told."""
    tasks = range(6 if policy == "deaf to lift" else 3)
    goals, frames = goals_of({task: SENTENCES[task] for task in tasks}), []
    always_green = generator.random() < 0.5
    families = {task: TOUCH if task < 3 else LIFT for task in tasks}
    for state in range(generator.integers(4, 13)):
        likes, rollouts = int(generator.integers(3)), []
        alone = policy == "pictures" and state % 2
        for task in [likes] * 3 if alone else tasks:
            kind, colour = task // 3, task % 3
            obeys = {
                "pictures": False,
                "deaf to lift": kind == 0,
                "hears red": colour == 0,
                "obeys mostly": generator.random() < 0.8,
            }[policy]
            free = likes if policy != "hears red" else 1 if always_green else 1 + int(generator.integers(2))
            rollouts.append((task, {3 * kind + (colour if obeys else free): 5}))
        frames.append(did(rollouts, goals, families, state=str(state)))
    return pl.concat(frames).with_columns(episode_index=pl.int_range(pl.len()))


#: Policies to which words do nothing, by name and number of kinds of other sentences.
NOTHING_HEARD = [*(("noise", kinds) for kinds in (1, 6, 20)), ("drift", 6), ("walk", 6), ("rounding", 6)]


def says_it_hears(policy: str, kinds: int, sets: int, planted: float = 0.0, inputs: int = 8) -> float:
    """The share of sets of calls of which `va.language_test` says that the policy hears.

    noise     every call draws noise of its own, as wide as the inputs differ
    drift     little noise, and every call moves on by as much as the inputs differ
    walk      every call moves on by a step that is drawn
    rounding  no noise; every sentence gives other last digits (1e-5)

    planted: by how much the first kind of sentence moves the action, in units of how far the inputs differ.
    """
    said = 0
    for number in range(sets):
        generator, state = np.random.default_rng([number, kinds]), {"at": 0.0}

        def call(place: float, told: str, draw: np.random.Generator = generator, at: dict[str, float] = state) -> Rows:
            noise = {"noise": 1.0, "drift": 0.1, "walk": 0.1}.get(policy, 0.0)
            at["at"] += {"drift": 1.0, "walk": draw.normal()}.get(policy, 0.0)
            plan = np.full((4, 7), place + at["at"]) + noise * draw.normal(size=(4, 7))
            return plan * (1 + 1e-5 * (policy == "rounding") * len(told)) + planted * (told == "kind 0")

        given = [(place, "own") for place in generator.normal(size=inputs).tolist()]
        with contextlib.redirect_stdout(io.StringIO()):
            found = va.language_test(call, given, [f"kind {'x' * kind}" if kind else "kind 0" for kind in range(kinds)])
        said += bool(found.findings[-1].numbers.get("hears"))
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

    Tasks and episodes scatter, each item scatters by tasks, and replans scatter. In a planted store the word "the", in
    all tasks, changes the action by `planted` times as much more.
    """
    generator = np.random.default_rng(number)
    scene, of_item = generator.normal(0, 0.2, (tasks, episodes)), dict[str, Rows]()

    def scale(name: str, task: int, episode: int, replan: int) -> float:
        del replan
        own = of_item.setdefault(name, generator.normal(0, 0.15, tasks))
        size = float(np.exp(scene[task, episode] + own[task] + generator.normal(0, 0.2)))
        return size * (1 + planted * ("word_the" in name))

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


def order_is_shown(number: int, planted: bool, folder: Path) -> bool:
    """Whether `effects` says that the order of a map by first order is shown to hold.

    In a null store it is drawn. In a planted one it is nine parts the sizes and one part another order of them.
    """
    plant = partial(planted_map, agrees=0.9 * planted, seed=number)
    spec = StoreSpec(tasks=(0, 1, 2), episodes=3, replans=3, layers=(0,), heads=(0,), frames=False, seed=number,
                     effect_items=("text", "map"), plant_effects=plant)  # fmt: skip
    found = va.open(write_store(folder / "a.zarr", spec=spec)).effects()
    return any(float(finding.numbers.get("rank_low") or 0.0) >= TRUSTED for finding in found.findings)


def main() -> None:
    """Print a line per command."""
    parser = argparse.ArgumentParser(description="How often commands name something in null stores.")
    parser.add_argument("--stores", type=int, default=200, help="stores of each kind (default: 200)")
    parser.add_argument("--planted", action="store_true", help="with something to find")
    kinds = ["analyze", "outcome", "time", "words", "words here", "compare", "language", "language_test", "effects",
             "map_order"]  # fmt: skip
    parser.add_argument("--kinds", nargs="+", default=kinds)
    arguments = parser.parse_args()
    what = "planted" if arguments.planted else "null"
    print(f"{arguments.stores} {what} stores of {TASKS} tasks x {EPISODES} episodes x {REPLANS} replans each:")
    for kind in arguments.kinds:
        if kind == "language":
            share = says_it_listens(arguments.stores, arguments.planted)
            print(f"  {kind:8} says that it listens in {share:.1%}", flush=True)
            for policy in PARTLY_DEAF:
                rates = of_a_listener(policy, arguments.stores)
                print(f"  {kind:8} {policy}: wrong in {rates['wrong']:.1%}, told in {rates['found']:.1%}", flush=True)
            continue
        if kind == "language_test":
            for policy, kinds_told in (
                [("noise", 1), ("noise", 6), ("noise", 20)] if arguments.planted else NOTHING_HEARD
            ):
                share = says_it_hears(policy, kinds_told, arguments.stores, 1.0 * arguments.planted)
                print(f"  {kind:8} {policy}, {kinds_told} kinds: says that it hears in {share:.1%}", flush=True)
            continue
        if kind == "effects":
            every = []
            for number in range(arguments.stores):
                with tempfile.TemporaryDirectory() as folder, contextlib.redirect_stdout(io.StringIO()):
                    every.append(named_by_effects(number, 1.0 * arguments.planted, Path(folder)))
            print(f"  {kind:8} names something in {sum(map(bool, every)) / len(every):.1%}", flush=True)
            for asks in EFFECT_SENTENCES:
                print(f"           {asks:40} {sum(asks in named for named in every) / len(every):.1%}", flush=True)
            continue
        named = 0
        for number in range(arguments.stores):
            with tempfile.TemporaryDirectory() as folder:
                ask = order_is_shown if kind == "map_order" else partial(names_something, kind)
                named += ask(number, arguments.planted, Path(folder))
        print(f"  {kind:8} names something in {named:4d} ({100 * named / arguments.stores:.1f} %)", flush=True)


if __name__ == "__main__":
    main()
