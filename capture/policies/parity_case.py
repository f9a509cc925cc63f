"""Parity cases of any family: folders with case.json, inputs.npz, and the reference's results in expected.npz."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any, Protocol, TypeVar
from zipfile import ZipFile

import numpy as np

from vla_attention.capture.foreign_files.checked_files import check_regular
from vla_attention.capture.policies.checkpoints import read_json_object
from vla_attention.schemas.errors import UserError, listing
from vla_attention.schemas.safe_text import visible

CASE_FILE = "case.json"
#: Characters of a case's name.
_NAME_LENGTH = 100
#: Bytes of the arrays in one file of a case; the largest case here has 20 MB.
MAX_ARRAYS_BYTES = 400_000_000


class UnusableCase(UserError, ValueError):
    """The case folder lacks a file, or a file lacks an entry that a case needs."""


class ParityResult(Protocol):
    """The outcome of one case."""

    @property
    def passed(self) -> bool:
        """Whether every difference is within its limit."""

    def as_json(self) -> dict[str, Any]:
        """Return the differences as plain JSON values."""


Result = TypeVar("Result", bound=ParityResult)


def read_case_file(folder: Path) -> dict[str, Any]:
    """Return the content of a folder's case.json; `UnusableCase` if there is none."""
    if not folder.is_dir():
        raise UnusableCase(f"There is no case folder at '{folder}'.")
    if not (folder / CASE_FILE).is_file():
        names = listing(sorted(path.name for path in folder.iterdir()))
        raise UnusableCase(f"'{folder}' is no case: it has no {CASE_FILE}, but {names}.")
    return read_json_object(folder / CASE_FILE)


def read_arrays(path: Path) -> dict[str, np.ndarray]:
    """Return the arrays of an npz file by their names; `UnusableCase` if it is missing or damaged."""
    try:
        check_regular(path, UnusableCase, inside=path.parent)
        with ZipFile(path) as opened:
            claimed = sum(member.file_size for member in opened.infolist())
        if claimed > MAX_ARRAYS_BYTES:
            raise UnusableCase(f"'{path}' holds {claimed} bytes of arrays; {MAX_ARRAYS_BYTES} at most are read.")
        with np.load(path, allow_pickle=False) as stored:
            return dict(stored)
    except UserError:
        raise
    except FileNotFoundError:
        raise UnusableCase(f"There is no '{path}', which a case needs.") from None
    except (
        Exception
    ) as error:  # a damaged zip, or an array whose header claims more than there is, raises almost anything
        raise UnusableCase(f"'{path}' cannot be read as arrays ({error}).") from error


def json_number(x: float) -> float | None:
    """Return a number for JSON; None for NaN and infinity, which JSON does not have."""
    return float(x) if np.isfinite(x) else None


def case_name(content: Mapping[str, Any], folder: Path) -> str:
    """Return the name that a case.json gives its case, visible and short, else that of its folder."""
    return visible(str(content.get("name", folder.name)))[:_NAME_LENGTH]


def print_results(results: Iterable[Result], as_text: Callable[[Result], str], *, as_json: bool) -> int:
    """Print each result when it is computed, or all as one JSON list; returns 0 if all passed, else 1."""
    done = []
    for result in results:
        done.append(result)
        if not as_json:
            print(as_text(result), flush=True)
    if as_json:
        print(json.dumps([result.as_json() for result in done], indent=2))
    return 0 if all(result.passed for result in done) else 1
