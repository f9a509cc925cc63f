"""How much the words of an instruction are read: mass, density, lift and share of words, of their classes, of roles."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import polars as pl
from numpy.typing import NDArray

from vla_attention.analyze.measures.baselines import uniform_keys, uniform_masses
from vla_attention.analyze.measures.frames import EPISODE_KEYS, LayerAxis, head_axis, long_table
from vla_attention.analyze.measures.kept import measured_once
from vla_attention.analyze.measures.masses import finite_mean, group_measures, masses
from vla_attention.analyze.measures.question import Question
from vla_attention.analyze.measures.selected import SelectedEpisode
from vla_attention.analyze.show.progress import progress_bar
from vla_attention.analyze.stores.parallel import each_episode
from vla_attention.analyze.stores.rows import layer_rows
from vla_attention.analyze.stores.selection import Selection
from vla_attention.schemas.errors import BadArgument
from vla_attention.schemas.groupings.resolve import counted_keys
from vla_attention.schemas.groupings.vocabulary import NO_WORDS
from vla_attention.schemas.groupings.words import word_class
from vla_attention.schemas.layout import Role

#: The roles of language: the linguistic group of the grouping 'default'. State digits are text, but not language.
LINGUISTIC_ROLES = (Role.BOS, Role.TEMPLATE, Role.INSTRUCTION, Role.TEXT)
#: Measured beside the words, for scale, where the site has such keys.
SCALE_ROLES = (Role.BOS, Role.TEMPLATE, Role.TEXT, Role.STATE, Role.IMAGE)
CONTENT, STOP = "content words", "stop words"


@dataclass(frozen=True)
class _Items:
    """What is measured in one episode: its words by place in the instruction, then classes and roles.

    `names`: (kind, word or name, place, class). `weights`: (replan or 1, key, item), then two further ones: all
    linguistic keys and all valid keys.
    """

    names: tuple[tuple[str, str, int | None, str | None], ...]
    weights: NDArray[np.float32]


def words_table(question: Question) -> pl.DataFrame:
    """Measure every word of every selected episode; shows progress at a terminal.

    Returns:
        One row per (episode, layer or "layers_avg"[, head], item), means over the episode's replans. An item (`kind`)
        is a "word" at a `place` of the instruction, from 0, with its `word_class` (content or stop), or, for "scale",
        all content words, all stop words, or the keys of a role (bos, template, text, state, image). Columns:
            pieces    number of keys
            mass      sum of the rows over these keys, mean over denoise steps and heads
            density   mass / pieces
            lift      as of a group, see `masses.group_measures`: 1 is what uniform attention gives
            share     mass / mass of all linguistic keys (bos, template, instruction, text; null where there is none)
        `density`, `lift` and `share` are computed per replan from masses that were averaged over denoise steps and
        heads (for "layers_avg" also over layers), as everywhere in `vla_attention.analyze.measures`.

    Raises:
        BadArgument: the keys of the site spell no words.
    """
    if not question.vocabulary.words:
        raise BadArgument(f"Site '{question.site}': {NO_WORDS}.")
    selected, selection, site = question.selected, question.selection, question.site
    with progress_bar(len(selected), "episodes") as advance:

        def measure(positions: Sequence[int]) -> Iterator[dict[str, NDArray[Any]]]:
            scan = partial(_word_masses, selection=selection, site=site)
            return each_episode(scan, [selected[i] for i in positions], advance)

        arrays = measured_once("words", "masses of words", selected, selection, site, measure, {}, progress=advance)
        return pl.concat(
            [_episode_words(item, one["mass"], selection) for item, one in zip(selected, arrays, strict=True)]
        )


def _episode_items(item: SelectedEpisode) -> _Items:
    tokens = item.tokens
    names: dict[tuple[str, str, int | None, str | None], int] = {}
    num_prompts, num_keys = max(1, len(tokens.prompts)), tokens.layout.num_keys
    by_prompt: list[NDArray[np.float32]] = []  # (prompt, key) of each item
    for which, words in enumerate(tokens.words):
        for place, word in enumerate(words):
            kind = word_class(word.text)
            for name in (
                ("word", word.text.casefold(), place, kind),
                ("scale", CONTENT if kind == "content" else STOP, None, kind),
            ):
                if name not in names:
                    names[name] = len(names)
                    by_prompt.append(np.zeros((num_prompts, num_keys), dtype=np.float32))
                by_prompt[names[name]][which, list(word.keys)] = 1.0
    stacked = np.stack(by_prompt, axis=-1) if by_prompt else np.zeros((num_prompts, num_keys, 0), dtype=np.float32)
    weights = stacked if len(stacked) == 1 else stacked[tokens.prompt_index]
    roles = tokens.static_roles
    members = []  # (replan or 1, key) of each role
    for role in SCALE_ROLES:
        if (roles == role).any():
            names[("scale", role.label, None, None)] = len(names)
            members.append(roles == role)
    members += [np.isin(roles, [int(role) for role in LINGUISTIC_ROLES]), item.valid]
    replans = max(len(weights), *(len(member) for member in members))
    parts = [np.broadcast_to(weights, (replans, *weights.shape[1:]))]
    parts += [np.broadcast_to(member, (replans, num_keys))[:, :, None].astype(np.float32) for member in members]
    whole = np.concatenate(parts, axis=2)
    whole[:, list(item.without)] = 0.0
    return _Items(tuple(names), whole)


def _word_masses(item: SelectedEpisode, selection: Selection, site: str) -> dict[str, NDArray[Any]]:
    """`mass` (replan, layer, head or 1, item), mean over denoise steps; the items are those of `_episode_items`."""
    items = _episode_items(item)
    heads = len(selection.heads) if selection.per_head else 1
    mass = np.zeros((item.tokens.num_replans, len(selection.layers), heads, items.weights.shape[2]))
    for part in layer_rows(item.store.attributes, item.episode, selection, site):
        mass[:, part.layer] += masses(part.rows, items.weights) / len(selection.denoise)
    return {"mass": mass}


def _episode_words(item: SelectedEpisode, mass: NDArray[np.float64], selection: Selection) -> pl.DataFrame:
    items = _episode_items(item)
    layers = LayerAxis.of(selection, average_one=False)
    mass = layers.with_average(mass)
    keys = counted_keys(items.weights, item.tokens.existing)
    uniform = uniform_masses(uniform_keys(item, selection), items.weights).mean(axis=2)
    if uniform.shape[1] > 1:
        uniform = layers.with_average(uniform)
    measures = group_measures(mass[..., :-2], mass[..., -1], keys[:, :-2], uniform[..., :-2], uniform[..., -1])
    with np.errstate(divide="ignore", invalid="ignore"):
        share = np.where(mass[..., -2:-1] > 0, measures.mass / mass[..., -2:-1], np.nan)
    outside = np.array([name in {Role.STATE.label, Role.IMAGE.label} for _, name, _, _ in items.names])
    share[..., outside] = np.nan  # no part of the linguistic mass
    pieces = np.broadcast_to(keys[:, None, None, :-2], measures.mass.shape)
    values = {
        "pieces": pieces,
        "mass": measures.mass,
        "density": measures.density,
        "lift": measures.lift,
        "share": share,
    }
    # Means over the replans whose prompt has the item.
    means = {name: finite_mean(np.where(pieces > 0, array, np.nan)) for name, array in values.items()}
    fields = (("kind", pl.String), ("item", pl.String), ("place", pl.Int64), ("word_class", pl.String))
    of_items = {
        field: pl.Series(field, [name[i] for name in items.names], dtype=kind) for i, (field, kind) in enumerate(fields)
    }
    return long_table(item, [layers.columns, head_axis(selection), of_items], means, EPISODE_KEYS)
