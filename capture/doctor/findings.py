"""What a check found, and how it is shown: a line each, with what to do."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal

#: `ok`: as it should be. `note`: works, but could be better, or is not needed. `missing`: the run needs it.
Status = Literal["ok", "note", "missing"]
_SHOWN: dict[Status, str] = {"ok": "ok", "note": "note", "missing": "MISSING"}


@dataclass(frozen=True)
class Finding:
    """One line: what was looked at, how it stands, and what to do where something is missing or could be better."""

    what: str
    status: Status
    text: str
    to_do: str = ""

    def describe(self) -> str:
        """Return the line for the terminal."""
        text = f"{self.text} {self.to_do}".strip()
        return f"{_SHOWN[self.status]:<8} {self.what:<11} {text}"


def something_missing(findings: Iterable[Finding]) -> bool:
    """Whether the run cannot be made as it is described."""
    return any(finding.status == "missing" for finding in findings)
