"""Every hostile store, results file and grouping ends with its sentence, in bounded memory and without a traceback."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from tests.kit.thorough import asked_for
from tests.thorough.hostile.make import CASES, PROGRAMS, make_case, originals

ROOT = Path(__file__).resolve().parents[3]
#: Bytes that a command may have resident beyond those of a command that works.
MOST_BYTES = 500_000_000


def run_in_child(commands: list[tuple[str, list[str]]]) -> list[dict[str, Any]]:
    """What each command printed and took, in one process with limits."""
    done = subprocess.run(
        [sys.executable, "-m", "tests.thorough.hostile.child"],
        input=json.dumps(commands),
        capture_output=True,
        text=True,
        cwd=ROOT,
        check=False,
    )
    results = [json.loads(line) for line in done.stdout.splitlines()]
    assert len(results) == len(commands), f"{commands[len(results)]} ended the process:\n{done.stderr[-4000:]}"
    return results


def problems_of(case: Any, result: dict[str, Any]) -> list[str]:
    """What is wrong with the end of a case's command."""
    printed = result["printed"]
    found = []
    if result["code"] != case.code:
        found.append(f"exit code {result['code']}, not {case.code}")
    if "Traceback" in printed:
        found.append("a traceback")
    if not re.search(case.sentence, printed, re.DOTALL):
        found.append(f"not the sentence {case.sentence!r}")
    if result["bytes"] > MOST_BYTES:
        found.append(f"{result['bytes'] / 1e6:.0f} MB")
    if len(printed) > 20_000 or not all(line.isprintable() for line in printed.split("\n")):
        found.append("a text that is long or no text")
    return [f"{case.name}: {', '.join(found)}; it printed: {printed[-1500:]}"] if found else []


@pytest.fixture(scope="module")
def ended(request, tmp_path_factory) -> dict[str, list[dict[str, Any]]]:
    """How the command of each case ended, by what it changes. One process runs all, as its start takes longest.

    Only the kinds are run that tests of this session ask for.
    """
    folder = tmp_path_factory.mktemp("hostile")
    made = originals(folder / "originals")
    commands = [
        ("analyze", [str(made["roots"]), "--group", "noun=word:bowl", "--no-cache", "--output", str(folder / "works")]),
        ("parse", ["--help"]),
    ]
    works = len(commands)
    run = {kind: CASES[kind] for kind in asked_for(request, "kind", CASES)}
    for kind, cases in run.items():
        program = PROGRAMS.get(kind, "analyze")
        for i, case in enumerate(cases):
            commands.append((program, make_case(kind, case, made[kind], folder / kind / f"{i:02d}")))
    results = run_in_child(commands)
    assert [result["code"] for result in results[:works]] == [0] * works, results[:works]
    rest = iter(results[works:])
    return {kind: [next(rest) for _ in cases] for kind, cases in run.items()}


@pytest.mark.parametrize("kind", CASES)
def test_hostile_files_end_with_their_sentence(ended, kind):
    pairs = list(zip(CASES[kind], ended[kind], strict=True))
    if os.environ.get("HOSTILE_FIGURES"):
        for case, result in pairs:
            print(f"{result['seconds']:6.2f} s {result['bytes'] / 1e6:6.0f} MB  {case.name}")
    problems = [line for case, result in pairs for line in problems_of(case, result)]
    assert not problems, "\n\n".join(problems)
