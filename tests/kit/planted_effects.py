"""Recorded effects of planted sizes, for stores of `tests.kit.stores`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise

import numpy as np

from tests.kit.stores import PlantEffects
from tests.kit.tokens import INSTRUCTIONS
from vla_attention.capture.interventions.condition_name import knockout_of_group
from vla_attention.capture.store.replan_records import ReplanEffects, ReplanMap
from vla_attention.schemas.effects import EffectItem, EffectMap
from vla_attention.schemas.groupings.vocabulary import EpisodeTokens
from vla_attention.schemas.groupings.words import words_of
from vla_attention.schemas.interventions import Interventions, KeyKnockout, NoiseChange, PromptChange
from vla_attention.schemas.layout import Role

READERS = {"total": ("all", ""), "direct": ("action", ""), "pictures": ("prefix", "role:image")}
WORDS = tuple(dict.fromkeys(word for text in INSTRUCTIONS for word in text.split()))
FIRST = INSTRUCTIONS[0].split()[0]
#: Item -> its selector, and the size of its change by reader.
ITEMS = {
    "visual": ("role:image", {"total": 2.0, "direct": 1.5, "pictures": 0.5}),
    "linguistic": ("role:instruction | role:template", {"total": 1.0, "direct": 0.2, "pictures": 0.8}),
    **{
        f"word_{word}": (
            f'word:"{word}"',
            {"total": 0.9 / (1 + i), "direct": 0.01 + 0.1 * i, "pictures": 0.7 / (1 + i)},
        )
        for i, word in enumerate(WORDS)
    },
}
NOISE, RANDOM = 0.05, 0.02


def item_of(name: str, change: str, queries: str, readers: str) -> EffectItem:
    kind, item = {"visual": ("pictures", ""), "linguistic": ("text", "")}.get(name, ("word", name[len("word_") :]))
    return EffectItem(change, kind, item, reader="pictures" if readers else queries)


def conditions(alike: float = 0.0, exchanged: bool = False) -> dict[str, tuple[Interventions, EffectItem, float]]:
    """By name; alike: the size of all changes, in place of their own. exchanged: words are exchanged for others too."""
    planted = {"unchanged": (Interventions("unchanged"), EffectItem("nothing"), 0.0)}
    planted["noise"] = (Interventions("noise", noise=NoiseChange(1)), EffectItem("noise"), NOISE)
    for name, (selector, sizes) in ITEMS.items():
        for reader, (queries, readers) in READERS.items():
            one = KeyKnockout(selector, queries=queries, query_selector=readers)
            made = knockout_of_group("without", name, one)
            planted[made.name] = (made, item_of(name, "without", queries, readers), sizes[reader])
    for queries, readers in READERS.values():
        one = KeyKnockout(f'word:"{FIRST}"', queries=queries, query_selector=readers, random_seed=1)
        made = knockout_of_group("random", f"word_{FIRST}", one)
        planted[made.name] = (made, item_of(f"word_{FIRST}", "random", queries, readers), RANDOM)
    for word, other in pairwise(WORDS) if exchanged else ():
        made = Interventions(f"exchange_word_{word}", prompt=PromptChange("synonyms", synonyms={word: other}))
        planted[made.name] = (made, EffectItem("prompt", "exchange", word, other), 1.0)
    return {name: (*of, size and (alike or size)) for name, (*of, size) in planted.items()}


def planted_effects(
    scale: Callable[[str, int, int, int], float] = lambda *_: 1.0,
    alike: float = 0.0,
    exchanged: bool = False,
    noise: bool = True,
) -> PlantEffects:
    """Every dimension changes by the size, in the sign of a coin; words of other instructions have no entry.

    scale: a factor of the size by the name of the condition, task, episode and replan. alike, exchanged: of
    `conditions`. noise: whether calls were made with other noise.
    """
    planted = conditions(alike, exchanged)
    if not noise:
        del planted["noise"]

    def plant(task: int, episode: int, replan: int, tokens: EpisodeTokens) -> ReplanEffects:
        return _effects_of(task, episode, replan, tokens, scale, planted)

    return plant


def _effects_of(
    task: int,
    episode: int,
    replan: int,
    tokens: EpisodeTokens,
    scale: Callable[[str, int, int, int], float],
    all_of: dict[str, tuple[Interventions, EffectItem, float]],
) -> ReplanEffects:
    known = INSTRUCTIONS[task % len(INSTRUCTIONS)].split()
    measured, changes = [], []
    for number, (name, (*_, size)) in enumerate(all_of.items()):
        word = name.split("word_")[-1].split("_queries")[0] if "word_" in name else known[0]
        if word in known:
            measured.append(number)
            signs = np.random.default_rng([task, episode, replan, number]).choice([-1.0, 1.0], (5, 7))
            changes.append(scale(name, task, episode, replan) * size * signs)
    roles = tokens.key_role[replan]
    keys_of = {"visual": roles == Role.IMAGE, "linguistic": np.isin(roles, [Role.INSTRUCTION, Role.TEMPLATE])}
    for word in words_of(tokens.prompts[tokens.prompt_index[replan]]):
        of_word = keys_of.setdefault(f"word_{word.text}", np.zeros(len(roles), dtype=bool))
        of_word[list(word.keys)] = True
    cut = np.zeros((len(measured), tokens.layout.num_keys), np.float32)
    for row, number in zip(cut, measured, strict=True):
        name = list(all_of)[number]
        if name.startswith("without_"):
            row[:] = keys_of[name.removeprefix("without_").split("_queries")[0]]
    listed, items = (tuple(of) for of in list(zip(*all_of.values(), strict=True))[:2])
    change = np.array(changes, np.float32)
    return ReplanEffects(listed, items, (3.0,) * 7, tuple(measured), change, {"joint": cut})


#: Patches of a planted map that are drawn at random.
DRAWN = 4


def planted_map(
    task: int,
    episode: int,
    replan: int,
    tokens: EpisodeTokens,
    agrees: float = 1.0,
    blocks: int = 0,
    named: float = 1.0,
    seed: int = 5,
) -> ReplanEffects:
    """Effects of words, and a map of the cameras with objects.

    agrees: how far the order of a map by first order agrees with the sizes, up to 1. blocks: so many in place of it,
    of patches in the order of their keys. named: how much larger sizes are where an object of interest is.
    """
    layout, generator = tokens.layout, np.random.default_rng([task, episode, replan, seed])
    keys = tuple(int(key) for camera in tokens.coverage or () for key in layout.patch_keys(camera))
    covered = np.concatenate(list((tokens.coverage or {}).values()), axis=1)[min(replan, tokens.num_replans - 1)]
    of_interest = covered[:, [thing.of_interest for thing in tokens.objects]].sum(axis=1)
    sizes = generator.uniform(0.1, 2.0, len(keys)) * (1 + (named - 1) * of_interest)
    if blocks:
        of_key = np.arange(len(keys)) * blocks // len(keys)
        sizes = np.bincount(of_key, sizes) / np.bincount(of_key)
        form = EffectMap("joint", keys, 0, 5, (), (), (), (), "hidden", tuple(map(int, of_key)))
        first, chosen, drawn = sizes, range(blocks), (False,) * blocks
    else:
        form = EffectMap("joint", keys, 8, 5, (), (), (), ())
        first = agrees * sizes + (1 - agrees) * generator.permutation(sizes)
        number, order = round(0.15 * len(keys)), np.argsort(-first)
        chosen = [*order[:number], *generator.permutation(order[number:])[:DRAWN]]
        drawn = tuple(at >= number for at in range(len(chosen)))
    change = np.stack([sizes[place] * np.ones((5, 7)) for place in chosen]).astype(np.float32)
    of = planted_effects()(task, episode, replan, tokens)
    one = ReplanMap(form, first.astype(np.float32), tuple(map(int, chosen)), drawn, change)
    return replace(of, map=one)
