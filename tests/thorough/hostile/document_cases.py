"""Results files and groupings, each one file that a user gives."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

from tests.thorough.hostile.changes import Case

RESULTS = ("--results", "FILE", "--output", "OUT")
GROUPING = ("STORE", "--grouping", "FILE", "--output", "OUT", "--no-cache")
NO_RESULTS = "is not a results file: "
NO_TOML = "is not valid TOML: "


def _step(**fields: Any) -> dict[str, Any]:
    step = {"step": 10, "visual_linguistic_ratio": 2.0, "visual_mass": 0.4, "linguistic_mass": 0.2}
    return step | {"visual_fraction": 0.66, "linguistic_fraction": 0.34} | fields


def _episode(**fields: Any) -> dict[str, Any]:
    episode = {"task_id": 0, "episode_idx": 0, "task_description": "put the bowl", "success": True, "num_steps": 50}
    return episode | {"summary": {}, "per_step_ratios": {"layer_5": [_step()]}} | fields


def _results(**fields: Any) -> Callable[[Path], object]:
    """A results file of one episode, with other fields."""
    return lambda file: file.write_text(json.dumps([_episode(**fields)]))


def _with_step(**fields: Any) -> Callable[[Path], object]:
    return _results(per_step_ratios={"layer_5": [_step(**fields)]})


def _digits(field: str, digits: str) -> Callable[[Path], object]:
    """A number as it stands in the text, for those that Python does not write."""
    text = json.dumps([_episode()])
    assert f'"{field}": ' in text
    return lambda file: file.write_text(text.replace(f'"{field}": ', f'"{field}": {digits}', 1))


def _text(text: str | bytes) -> Callable[[Path], object]:
    return lambda file: file.write_bytes(text if isinstance(text, bytes) else text.encode())


def _device(file: Path) -> None:
    file.symlink_to("/dev/zero")


def _sparse(file: Path) -> None:
    with file.open("wb") as opened:
        opened.truncate(10**12)


def _groups(groups: str) -> Callable[[Path], object]:
    return _text(f"[groups]\n{groups}\n")


def _one(selector: str) -> Callable[[Path], object]:
    return _groups(f"a = '{selector}'\nrest = '*'")


RESULTS_CASES = [
    Case("results: a FIFO", os.mkfifo, "it is a FIFO and no regular file", RESULTS),
    Case("results: a device", _device, "it is a device and no regular file", RESULTS),
    Case("results: a terabyte", _sparse, "it has 1,000,000,000,000 bytes; expected at most", RESULTS),
    Case("results: deep lists", _text("[" * 10**6), NO_RESULTS + ".*nested more than 64 deep", RESULTS),
    Case("results: 5,000 digits", _digits("task_id", "9" * 5000), NO_RESULTS + ".*64 bits", RESULTS),
    Case("results: a mass below 0", _with_step(visual_mass=-1e308), "expected a number from 0", RESULTS),
    Case("results: an infinite mass", _with_step(visual_mass=float("inf")), "expected a finite mass", RESULTS),
    Case("results: half a surrogate", _results(task_description="\udc00"), NO_RESULTS + ".*surrogate", RESULTS),
    Case("results: a layer of 1 MB", _results(per_step_ratios={"x" * 10**6: []}), r"has 'xxx.*\[\.\.\. 999,", RESULTS),
    Case("results: a summary of texts", _results(summary={"layer_5": {"x": {"mean": "x"}}}), "is a text", RESULTS),
    Case("results: no episode", _text("[]"), "it holds no episode", RESULTS),
]

GROUPING_CASES = [
    Case("grouping: a FIFO", os.mkfifo, "it is a FIFO and no regular file", GROUPING),
    Case("grouping: 5 MB", _text("#" * 5_000_000), "it has 5,000,000 bytes; expected at most 4,000,000", GROUPING),
    Case("grouping: deep lists", _text("a = " + "[" * 10**6), NO_TOML + ".*nested more than 64 deep", GROUPING),
    Case("grouping: 10^5 dots", _text("a" + ".a" * 10**5 + " = 1"), NO_TOML + ".*nested more than 64 deep", GROUPING),
    Case("grouping: 5,000 digits", _text(f"a = {'9' * 5000}"), NO_TOML + ".*more than 4,000 digits", GROUPING),
    Case("grouping: 2,000 groups", _groups("\n".join(f"g{i} = '*'" for i in range(2000))), "has 2000 groups", GROUPING),
    Case(
        "grouping: a ratio of 1 MB",
        _groups(f"a = '*'\n[ratio]\nnumerator = ['{'x' * 10**6}']\ndenominator = ['a']"),
        "refers to group 'xxx",
        GROUPING,
    ),
    Case("selector: 400 parentheses", _one("(" * 400 + "*" + ")" * 400), "more than 100 parentheses in one", GROUPING),
    Case(
        "selector: 10^5 unions",
        _one(" | ".join(["word:bowl"] * 10**5 + ["word:nothing"])),
        "no instruction has the word 'nothing'",
        GROUPING,
    ),
    Case("selector: 10^6 spaces", _one("word:bowl" + " " * 10**6 + "?"), "expected KIND:NAME", GROUPING),
    Case("selector: keys of 5,000 digits", _one("keys:0-" + "9" * 5000), "Cannot read selector 'keys:0-999", GROUPING),
    Case(
        "selector: patches of 5,000 digits", _one(f"patch:base_0_rgb[0:{'9' * 5000},0:1]"), "Cannot read sel", GROUPING
    ),
    Case("selector: a word of 1 MB", _one(f"word:{'x' * 10**6}"), "no instruction has the word 'xxx", GROUPING),
]
