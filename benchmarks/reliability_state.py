"""What a part of `reliability.py` found, one line of JSON for each case, so that an interrupted run goes on."""

from __future__ import annotations

import json
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any


@dataclass(frozen=True)
class Results:
    """The cases of one part in a file. Each has a `series`, a `number` in it, and `problems`: empty if all is well."""

    path: Path

    def add(self, case: dict[str, Any]) -> None:
        """Add a case, and say what is wrong with it."""
        self.path.parent.mkdir(parents=True, exist_ok=True)
        with self.path.open("a", encoding="utf-8") as file:
            file.write(json.dumps(case) + "\n")
        for problem in case["problems"]:
            print(f"{case['series']} {case['number']}: {problem}", flush=True)

    def cases(self) -> list[dict[str, Any]]:
        """All cases; a line that was cut off by a kill is left out."""
        found = []
        for line in self.path.read_text(encoding="utf-8").splitlines() if self.path.exists() else []:
            try:
                found.append(json.loads(line))
            except json.JSONDecodeError:
                continue
        return found

    def series(self) -> dict[str, list[dict[str, Any]]]:
        """The cases by series, in the order of their first case."""
        found: dict[str, list[dict[str, Any]]] = {}
        for case in self.cases():
            found.setdefault(case["series"], []).append(case)
        return found

    def missing(self, series: str, numbers: Iterable[int]) -> list[int]:
        """The numbers of a series that were not tried yet."""
        done = {case["number"] for case in self.cases() if case["series"] == series}
        return [number for number in numbers if number not in done]
