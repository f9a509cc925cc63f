"""The tables of `maps.py` in `docs/validation.md`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.validation.map_calls import MAPS
from benchmarks.validation.policies import TITLES
from benchmarks.validation.ranks import spearman
from benchmarks.validation.tables import markdown
from vla_attention.analyze.statistics.student import student_quantile

#: Number -> what it is; the first ones are how far the action moves, the truth that the maps are held against.
MOVES = {
    "noise": "another noise seed",
    "wrist_blank": "a grey wrist camera",
    "mark_filled": "the mark taken out of the picture",
    "other_mark": "another mark",
    "prompt_other_colour": "another colour in the prompt",
    "sentence moves": "another colour in the prompt, first call",
    "mark moves": "another colour of the mark, first call",
}
#: What is read off every map.
PARTS = {
    "wrist": "part on the wrist camera",
    "mark": "part on the mark's patch",
    "mark first": "part on the mark's patch, first call",
    "top": "calls whose strongest patch is the mark's",
    "top first": "first calls whose strongest patch is the mark's",
    "tenth": "calls with the mark's patch in the top tenth",
    "tenth first": "first calls with the mark's patch in the top tenth",
    "nmr": "part of the top tenth on neither the named cubes nor the robot",
    "named": "named against other cube",
    "sentence told": "the same cube, named by the sentence against not named, first call",
    "mark told": "the same cube, named by the mark against not named, first call",
}
#: Those of `PARTS` that are parts of all calls.
COUNTS, ON_MARK = ("top", "tenth"), ("mark", "mark first")
RANDOM = "random order"
Numbers = Mapping[str, Sequence[float]]
Results = Mapping[str, Any]


def interval(values: Sequence[float] | NDArray[np.float64] | None, digits: int = 2) -> str:
    """The mean, and Student's t interval where there are several values."""
    if values is None or not len(values):
        return "-"
    mean, number = float(np.mean(values)), len(values)
    if number < 2:
        return f"{mean:.{digits}f}"
    half = student_quantile(0.95, number - 1) * float(np.std(values, ddof=1)) / number**0.5
    return f"{mean:.{digits}f} [{mean - half:.{digits}f}, {mean + half:.{digits}f}]"


def _with_number(values: Sequence[float]) -> str:
    """The mean, and of how many."""
    return f"{np.mean(values):.2f} ({len(values)})" if values else "-"


def _kinds(results: Results) -> dict[str, list[Mapping[str, Any]]]:
    """Kind of policy -> its trainings."""
    found = {kind: [one for one in results["policies"] if one["control"] == kind] for kind in TITLES}
    return {kind: own for kind, own in found.items() if own}


def truths_table(results: Results) -> str:
    """How far each change moves the action: a column for each kind of policy, a value for each training."""
    kinds = _kinds(results)
    rows = [("solved, of 12", *(", ".join(f"{one['solved']}" for one in own) for own in kinds.values()))]
    for name, title in MOVES.items():
        cells = ("; ".join(interval(one["numbers"].get(name)) for one in own) for own in kinds.values())
        rows.append((title, *cells))
    return markdown(("moves the action", *(TITLES[kind] for kind in kinds)), rows)


def parts_table(results: Results) -> str:
    """What is read off the maps: a row for each part and kind of policy, a column for each map."""

    def cell(part: str, numbers: Numbers, name: str) -> str:
        values = numbers[f"{part} {name}"]
        if part.startswith(COUNTS):
            return f"{100 * np.mean(values):.0f} %"
        return interval(values, 3 if part in ON_MARK else 2)

    rows = []
    for part, title in PARTS.items():
        for kind, own in _kinds(results).items():
            known = [one["numbers"] for one in own if f"{part} exact" in one["numbers"]]
            if known:
                cells = ("; ".join(cell(part, numbers, name) for numbers in known) for name in MAPS)
                rows.append((title, TITLES[kind], *cells))
                title = ""
    return markdown(("what is read off the map", "policy", *MAPS.values()), rows)


def curves_table(results: Results) -> str:
    """A row for each map: how far the action moves without its best patches, or with them alone."""
    numbers: Numbers = results["curves"]
    ways = [(way, how) for how in ("tokens", "pixels") for way in ("deletion", "insertion")]
    of = {name: [np.array(numbers[f"{way} {how} {name}"]) for way, how in ways] for name in (*MAPS, "random")}
    rows = [(title, *(interval(one, 3) for one in of[name])) for name, title in (*MAPS.items(), ("random", RANDOM))]
    rows += [
        (
            f"{MAPS[name]}, minus exact",
            *(interval(one - exact, 3) for one, exact in zip(of[name], of["exact"], strict=True)),
        )
        for name in list(MAPS)[1:]
    ]
    said = {"deletion": "the best", "insertion": "all but the best"}
    hidden = {"tokens": "hidden from all tokens", "pixels": "blurred in the picture"}
    return markdown(("order of the patches by", *(f"{said[way]} {hidden[how]}" for way, how in ways)), rows)


def levels_table(results: Results) -> str:
    """The deletion curves of the tokens, at each level."""
    numbers, levels = results["curves"], results["levels"]
    rows = [
        (title, *(f"{np.mean(numbers[f'deletion tokens {name} {i}']):.3f}" for i in range(len(levels))))
        for name, title in (*MAPS.items(), ("random", RANDOM))
    ]
    return markdown(("the best by", *(f"{100 * level:.0f} %" for level in levels)), rows)


def seeds_table(results: Results) -> str:
    """A row for each map: its rank correlation with others of the same call."""
    numbers = results["curves"]
    rows = [
        (title, *(interval(numbers[f"{part} {name}"]) for part in ("exact", "seed", "mean")))
        for name, title in MAPS.items()
    ]
    return markdown(
        ("map", "with exact knock-outs", "with itself, another seed", "with the mean of four other seeds"), rows
    )


def suites_table(results: Results) -> str:
    """A row for each condition: success and NMR; the last row is over the conditions."""
    rows = []
    for one in results["suites"]:
        numbers = one["numbers"]
        outcomes = list(zip(numbers["episodes"], numbers["solved"], strict=True))
        halves = [[nmr for nmr, solved in outcomes if solved == wanted] for wanted in (1.0, 0.0)]
        rows.append(
            (
                one["title"],
                f"{one['solved']} of {one['episodes']}",
                interval(numbers["area"]),
                interval(numbers["nmr"]),
                *map(_with_number, halves),
            )
        )
    parts = [one["solved"] / one["episodes"] for one in results["suites"]]
    nmr = [float(np.mean(one["numbers"]["nmr"])) for one in results["suites"]]
    if len(rows) > 2 and len(set(parts)) > 1:
        correlation = f"{spearman(np.array(parts), np.array(nmr)):.2f}"
        rows.append(("rank correlation of success and NMR, over the rows", "", "", correlation, "", ""))
    return markdown(("what", "solved", "part of the pictures", "NMR@10", "of solved episodes", "of the others"), rows)


def map_blocks(results: Results) -> dict[str, str]:
    """The tables by their marks in the page."""
    return {
        "map truths": truths_table(results),
        "map parts": parts_table(results),
        "map curves": f"{curves_table(results)}\n\n{levels_table(results)}",
        "map seeds": seeds_table(results),
        "map suites": suites_table(results),
    }
