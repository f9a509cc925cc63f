"""Groupings on made-up episodes, right and wrong ones, as JSON that another language can read, with Python's answers.

    cases = grouping_cases(300)
    cases["cases"][0]["expected"]       # {"error": sentence} or weights, numbers of keys, masses, lifts, ratio ...

Every number follows from the case's number alone. Layouts are of all kinds: one site with cameras, prompt and actions
(pi), latent frames (Cosmos), generated tokens and absent keys, cameras without coverage, up to 150 objects.
"""
# ruff: noqa: RUF001 - letters that look like others are meant

from __future__ import annotations

import math
from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any

import numpy as np
import polars as pl
from numpy.typing import NDArray

from tests.analyze.view.grouping_episodes import NUM_EPISODES, made_up_episode
from vla_attention.analyze.core.levels import MORE, items_of, replan_cells
from vla_attention.analyze.core.measure import Measured, means
from vla_attention.analyze.measures.frames import EPISODE_KEYS, float_values
from vla_attention.analyze.measures.masses import masses, uniform_masses
from vla_attention.analyze.measures.selected import SelectedEpisode, resolve_all
from vla_attention.analyze.stores.selection import Selection
from vla_attention.schemas.errors import UserError
from vla_attention.schemas.groupings.builtin_groupings import BUILTIN_GROUPINGS, find_grouping
from vla_attention.schemas.groupings.grouping import (
    Grouping,
    parse_group_argument,
    parse_ratio_argument,
    with_groups,
)
from vla_attention.schemas.groupings.key_counts import uniform_of_version_1, uniform_rows
from vla_attention.schemas.groupings.resolve import counted_keys
from vla_attention.schemas.groupings.vocabulary import EpisodeTokens, collect_vocabulary
from vla_attention.schemas.jsonable import to_json
from vla_attention.schemas.layout import Role
from vla_attention.schemas.segments import segment_members, segments_of, weights_on_segments

#: Layers, denoise steps and heads of the rows of a case.
AXES = (2, 2, 2)
_KINDS = ("camera", "role", "span", "frame", "word", "words", "object", "patch", "keys")
_GARBAGE = "()&|-*:[],\"' =#0a_é’\u3000\x1c\n\u202e🤖"


def grouping_cases(count: int, seed: int = 16) -> dict[str, Any]:
    """`count` cases with what Python makes of each, and the episodes that they are about."""
    episodes = [made_up_episode(seed, number) for number in range(NUM_EPISODES)]
    cases = [_case(seed, number, episodes) for number in range(count)]
    return {"episodes": [_episode_json(tokens) for tokens in episodes], "cases": cases}


def _case(seed: int, number: int, episodes: Sequence[EpisodeTokens]) -> dict[str, Any]:
    generator = np.random.default_rng([seed, 1, number])
    position = number % len(episodes)
    tokens = episodes[position]
    given = _given(generator, number, tokens)
    # Names may exist in another episode of the same layout only: then the group has no key here.
    others = [i for i, other in enumerate(episodes) if other.layout == tokens.layout] if number % 3 else [position]
    rows = _rows(generator, tokens)
    uniform = _uniform(generator, tokens) if number % 4 else None
    case = {"episode": position, "vocabulary": others, **given, "rows": rows.ravel().tolist(), "uniform": None}
    if uniform is not None:
        case["uniform"] = {"shape": list(uniform.shape), "values": uniform.ravel().tolist()}
    return {**case, "expected": _expected(given, tokens, [episodes[i] for i in others], rows, uniform)}


def _given(generator: np.random.Generator, number: int, tokens: EpisodeTokens) -> dict[str, Any]:
    """What a user gives: a built-in grouping's name, or `--group` arguments and perhaps a base and a ratio."""
    overlap, empty = bool(generator.random() < 0.9), bool(generator.random() < 0.9)
    given: dict[str, Any] = {"base": None, "groups": [], "ratio": None, "overlap": overlap, "allow_empty": empty}
    if number % 10 == 0:
        near = ["referense", "reference:", "reference:7", "reference:٣", "reference:99999999999999999999", "Objects"]
        given["base"] = str(generator.choice([*BUILTIN_GROUPINGS, *near]))
        return given
    if number % 10 == 1:
        given["base"] = str(generator.choice(["default", "cameras", "instruction"]))
    mistake = number % 2 == 1
    for i in range(int(generator.integers(1, 4))):
        name = str(generator.choice(["bowl", "visual", "linguistic", "a.b-c@d", f"g{i}", f"g{i}"]))
        given["groups"].append(f"{name}={_selector(generator, tokens, 0, mistake)}")
    if generator.random() < 0.2:
        given["groups"].append("others=*")
    if mistake and generator.random() < 0.25:
        given["groups"][-1] = str(generator.choice(["=word:a", "a", "ratio=*", "é=*", f"{'n' * 300}=*", "a==", "a= *"]))
    names = [text.partition("=")[0] for text in given["groups"]]
    if generator.random() < 0.5:
        wrong = ["a", "a/", "a,/ ", "nothing/rest", "vsual/linguistic"]
        given["ratio"] = f"{names[0]}/{names[-1]}" if not mistake else str(generator.choice(wrong))
    return given


def _selector(generator: np.random.Generator, tokens: EpisodeTokens, depth: int, mistake: bool) -> str:
    kind = generator.random()
    if mistake and depth == 0:
        if kind < 0.2:
            return _long_selector(generator)
        if kind < 0.45:
            return _with_garbage(generator, _selector(generator, tokens, 1, False))
        if kind < 0.8:
            return _wrong_atom(generator, tokens)
    if depth > 2 or kind < 0.35:
        atom = _wrong_atom(generator, tokens) if mistake and generator.random() < 0.7 else _atom(generator, tokens)
        return atom if generator.random() > 0.05 else "*"
    left, right = (_selector(generator, tokens, depth + 1, mistake) for _ in range(2))
    operator = str(generator.choice(["&", "|", " - ", " | ", " & ", "\t-\n"]))
    joined = f"{left}{operator}{right}"
    return f"({joined})" if generator.random() < 0.5 else joined


def _long_selector(generator: np.random.Generator) -> str:
    nested = ["(" * depth + "keys:3" + ")" * depth for depth in (100, 101, 150)]
    long = [" | ".join(["word:bowl"] * 400), "word:" + "b" * 400, "role:" + "x" * 5000, "kind" * 100 + ":a"]
    return str(generator.choice([*nested, *long]))


def _with_garbage(generator: np.random.Generator, text: str) -> str:
    characters = list(text)
    for _ in range(int(generator.integers(1, 4))):
        place = int(generator.integers(0, len(characters) + 1))
        if generator.random() < 0.5:
            characters.insert(place, str(generator.choice(list(_GARBAGE))))
        else:
            del characters[place : place + 1]
    return "".join(characters)


def _quoted(generator: np.random.Generator, name: str) -> str:
    if any(character in name for character in " &|()\"'") or generator.random() < 0.2:
        return f'"{name}"' if '"' not in name else f"'{name}'"
    return name


def _atom(generator: np.random.Generator, tokens: EpisodeTokens) -> str:
    layout = tokens.layout
    camera = next((name for name in layout.pictured), None)
    words = [word.text for line in tokens.words for word in line]
    choices: list[str] = [f"span:{_quoted(generator, span.name)}" for span in layout.spans]
    choices += [f"camera:{_quoted(generator, name)}" for name in layout.cameras]
    choices += [f"role:{Role(code).label}" for code in np.unique(tokens.key_role)]
    choices += [f"words:{name}" for name in ("content", "stop", "all", "STOP")] * bool(words)
    choices += [f"frame:{span.name}" for span in layout.spans if span.kind == "latent"]
    choices += [f"frame:{name}" for name in ("frame0", "frame٢", "curr_last") if layout.spans[0].kind == "latent"]
    if words:
        first = int(generator.integers(0, len(tokens.words[0])))
        phrase = " ".join(word.text for word in tokens.words[0][first : first + 2])
        choices += [f"word:{_quoted(generator, word)}" for word in words[:6]]
        choices += [f'word:"{phrase}"', f"word:{words[-1].upper()}"]
    if tokens.coverage:
        named = [thing.name for thing in tokens.objects[:4]]
        choices += [f"object:{name}" for name in (*named, "@interest", "@robot", "@background")] * 2
    if camera is not None:
        rows, columns = layout.grids(camera)[0].rows, layout.grids(camera)[0].columns
        r, c = int(generator.integers(0, rows)), int(generator.integers(0, columns))
        regions = [f"{camera}[{r}:,:{c + 1}]", f"{camera}[:{rows}, {c}:{columns}]"]
        regions += [
            f"{camera}[{r / rows}:1,:{(c + 1) / columns:.17f}]",
            f"{camera}[.25:, 0:0.{c + 3}]",
            f"{camera}[:,:]",
        ]
        choices += [f"patch:{_quoted(generator, region) if ' ' in camera else region}" for region in regions] * 2
    last = int(generator.integers(0, layout.num_keys))
    choices += [f"keys:0-{last}", f"keys:{last}"]
    return str(generator.choice(choices))


def _wrong_atom(generator: np.random.Generator, tokens: EpisodeTokens) -> str:
    """Something that cannot be read, or a name that is near an existing one or near none."""
    right = _atom(generator, tokens)
    kind, _, argument = right.partition(":")
    camera = next(iter(tokens.layout.cameras), "base")
    choices = [
        *(f"{any_kind}:{argument}" for any_kind in generator.choice(_KINDS, 2)),
        f"{kind}:{argument[:-1]}x",
        f"{kind}:{argument[: max(1, len(argument) // 2)]}",
        f"{kind}:{argument.upper()}",
        f"{kind}s:{argument}",
        f"{kind}:",
        f'{kind}:" "',
        *("word:,", 'word:"bowl plate bowl"', "word:bowls", "words:nouns", "role:images", "object:@interests"),
        *(
            "object:plate",
            "frame:frame99",
            "frame:primry",
            "keys:3-1",
            "keys:1000000",
            "keys:a",
            "keys:٣",
            "span:promt",
        ),
        *(f"patch:{camera}[0:99,0:1]", f"patch:{camera}[0:1]", f"patch:{camera}", "patch:nowhere[0:1,0:1]"),
        *(
            f"patch:{camera}[1:1,0:1]",
            f"patch:{camera}[0.5:1.5,:]",
            f"patch:{camera}[0.5:0.5,:]",
            f"patch:{camera}[.:,:]",
        ),
    ]
    if tokens.words:
        line = [word.text for word in tokens.words[0]]
        choices += [f'word:"{line[-1]} {line[0]}"', f'words:"{line[0]}"'] * 6
    return str(generator.choice(choices))


def _rows(generator: np.random.Generator, tokens: EpisodeTokens) -> NDArray[np.float64]:
    """Rows (replan, layer, denoise, head, key) that sum to 1.

    At times a group has no mass, in all layers or in one, or a row has none at all.
    """
    shape = (tokens.num_replans, *AXES, tokens.layout.num_keys)
    valid = np.broadcast_to(tokens.valid, (tokens.num_replans, tokens.layout.num_keys))[:, None, None, None]
    weights = np.exp(generator.normal(0, 3, shape)) * valid
    if generator.random() < 0.2:
        weights[..., : tokens.layout.spans[0].stop] = 0.0
    if generator.random() < 0.4:
        weights[:, 0, ..., : tokens.layout.spans[0].stop] = 0.0
    sums = weights.sum(axis=-1, keepdims=True)
    rows = np.divide(weights, sums, out=np.zeros_like(weights), where=sums > 0)
    return rows.astype(np.float32).astype(np.float64)


def _uniform(generator: np.random.Generator, tokens: EpisodeTokens) -> NDArray[np.float32]:
    """What uniform attention gives under random masks (replan, layer, denoise, head, query, key), as stores hold it.

    Along a random choice of axes nothing changes; queries are kept apart or are the mean of some.
    """
    lengths = (tokens.num_replans, *AXES, 3)
    shape = [length if generator.random() < 0.5 else 1 for length in lengths]
    seen = generator.random((*shape, tokens.layout.num_keys)) < generator.choice([0.9, 0.5, 0.1])
    seen[..., generator.integers(tokens.layout.num_keys)] |= ~seen.any(axis=-1)
    uniform = uniform_rows(seen)
    if generator.random() < 0.5:
        uniform = uniform.mean(axis=4, keepdims=True)
    return uniform.astype(np.float32)


def chosen_grouping(given: dict[str, Any], vocabulary: Any) -> Grouping:
    """The grouping of a case, as `choose_grouping` makes it of a command line; the rest as a file would say it."""
    base = find_grouping(given["base"], vocabulary) if given["base"] is not None else None
    grouping = base
    if given["groups"]:
        grouping = with_groups(base, [parse_group_argument(text) for text in given["groups"]])
    assert grouping is not None
    ratio = grouping.ratio if given["ratio"] is None else parse_ratio_argument(given["ratio"])
    return Grouping(
        name=grouping.name,
        groups=grouping.groups,
        ratio=ratio,
        overlap=grouping.overlap or given["overlap"],
        allow_empty=grouping.names if given["allow_empty"] else grouping.allow_empty,
        description=grouping.description,
    )


def _expected(
    given: dict[str, Any],
    tokens: EpisodeTokens,
    others: Sequence[EpisodeTokens],
    rows: NDArray[np.float64],
    uniform: NDArray[np.float32] | None,
) -> dict[str, Any]:
    """What Python makes of a case; `uniform`: what a store of version 2 holds, None for one of version 1."""
    attributes = SimpleNamespace(task_id=0, instruction="", episode_index=0, success=None, num_steps=0)
    store, episode = SimpleNamespace(suite="made_up"), SimpleNamespace(attributes=attributes)
    item = SelectedEpisode(store, episode, tokens)  # type: ignore[arg-type] - no more of them is needed
    try:
        vocabulary = collect_vocabulary(others)
        grouping = chosen_grouping(given, vocabulary)
        (resolved,) = resolve_all(grouping, [item], vocabulary)
    except UserError as error:
        return {"error": str(error)}
    items = items_of(item, grouping)
    weights = items.with_totals(item).astype(np.float64)  # as the page; so are the sums of both sides of the ratio
    if grouping.ratio is not None:
        for i, side in enumerate((grouping.ratio.numerator, grouping.ratio.denominator), len(grouping.names)):
            weights[..., i] = weights[..., [grouping.names.index(name) for name in side]].sum(axis=-1)
    mass = masses(rows, weights)  # type: ignore[arg-type]
    layers, denoise, heads = (tuple(range(length)) for length in AXES)
    selection = Selection(layers, layers, layers, denoise, denoise, heads, heads, per_head=False)
    mean = mass.mean(axis=3, keepdims=True)
    if uniform is None:
        keys = uniform_of_version_1(tokens.layout, tokens.static_roles, item.valid, tokens.num_queries)
        of_cells = keys[:, None, None, None]
    else:
        of_cells = uniform.mean(axis=(3, 4), dtype=np.float64)[:, :, :, None]
    expected = uniform_masses(of_cells, weights)
    names = len(grouping.names)
    measured = Measured(
        item, selection, items.labels, items.absent, mean[..., :-2], mean[..., :names].sum(axis=-1), mean[..., -1],
        counted_keys(weights, tokens.existing)[:, :-2], expected[..., :-2], expected[..., -1], mean[..., -1],
        item.num_valid, np.arange(tokens.num_replans), np.zeros(len(denoise)),
    )  # fmt: skip
    found = means(measured, ("replan", "layer"), MORE)
    groups, cells = found.filter(kind="group").rename({"share": "fraction"}), replan_cells(found, grouping)
    segments = segments_of(tokens.layout, tokens.key_role)
    members = segment_members(tokens.layout, tokens.static_roles, segments)
    on_segments = weights_on_segments(_with_valid(resolved.weights, item.valid), members)
    return {
        "names": list(grouping.names),
        "name": grouping.name,
        "description": grouping.description,
        "weights": _every(resolved.weights.swapaxes(1, 2), tokens),
        "num_keys": _every(resolved.num_keys, tokens),
        "num_valid": _every(np.asarray(resolved.num_valid, dtype=np.float64), tokens),
        "segments": to_json(segments),
        "on_segments": None if on_segments is None else _every(on_segments.swapaxes(1, 2), tokens),
        "groups": {name: _column(groups, name) for name in ("mass", "fraction", "density", "lift")},
        "cells": {name: _column(cells, name) for name in cells.columns if name not in _PLACES},
    }


_PLACES = (*EPISODE_KEYS, "replan", "env_step", "layer", "layer_number", "block")


def _column(rows: pl.DataFrame, name: str) -> list[float | str]:
    return _numbers(float_values(rows[name]))


def _with_valid(weights: NDArray[np.float32], valid: NDArray[np.bool_]) -> NDArray[np.float32]:
    """Weights (replan or 1, key, group) with one more group: the valid keys (replan or 1, key)."""
    replans = max(len(weights), len(valid))
    parts = (weights, valid[:, :, None].astype(np.float32))
    return np.concatenate([np.broadcast_to(part, (replans, *part.shape[1:])) for part in parts], axis=2)


def _every(array: NDArray[Any], tokens: EpisodeTokens) -> list[float | str]:
    """Values (replan or 1, ...) of every replan, flat."""
    return _numbers(np.broadcast_to(array, (tokens.num_replans, *array.shape[1:])))


def _numbers(array: NDArray[Any]) -> list[float | str]:
    """Values as JSON has them: flat, in C order, and what is not finite as text."""
    return [value if math.isfinite(value) else str(value) for value in np.asarray(array, np.float64).ravel().tolist()]


def _episode_json(tokens: EpisodeTokens) -> dict[str, Any]:
    return {
        "layout": to_json(tokens.layout),
        "key_role": tokens.key_role.ravel().tolist(),
        "num_replans": tokens.num_replans,
        "prompts": to_json(tokens.prompts),
        "prompt_index": [] if tokens.prompt_index is None else tokens.prompt_index.tolist(),
        "objects": to_json(tokens.objects),
        "coverage": {
            camera: {"shape": list(area.shape), "values": area.ravel().tolist()}
            for camera, area in (tokens.coverage or {}).items()
        },
        "num_queries": tokens.num_queries,
    }
