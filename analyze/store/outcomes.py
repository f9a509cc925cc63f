"""Telling a store the outcomes of its episodes after they were recorded: from a scorer, or a person."""

from __future__ import annotations

import csv
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from vla_attention.schemas.errors import BadArgument, listing, plural
from vla_attention.schemas.stores.locks import WHOLE_STORE, store_locks
from vla_attention.schemas.stores.outcomes import OUTCOMES_FILE, LaterOutcome, write_outcomes
from vla_attention.schemas.stores.reader import open_store
from vla_attention.schemas.stores.store_format import episode_name

COLUMNS = ("task_id", "episode_index", "success")
_NUMBER = re.compile(r"[0-9]{1,9}")
_VALUES = {"1": True, "true": True, "1.0": True, "0": False, "false": False, "0.0": False}


@dataclass(frozen=True)
class Told:
    """What was told: outcomes that are new, outcomes that were known to be the same, columns that were not read."""

    added: int
    known: int
    unread: tuple[str, ...]


def tell_outcomes(path: Path, file: Path) -> Told:
    """Give a store's episodes the outcomes in a CSV file; all of them, or none if one cannot be given.

    Raises:
        BadArgument: the file cannot be read, or a row names no episode, one that another row names, or another outcome
            than the episode has.
        CorruptEpisode: an episode is damaged.
    """
    rows, unread = _rows_of(file)
    with store_locks(path).part(WHOLE_STORE) as building:
        store = open_store(path)
        episodes = {episode.name: episode for episode in store.episodes}
        if lacking := [name for name in rows if name not in episodes]:
            raise BadArgument(
                f"{file} names {plural(len(lacking), 'episode')} that {path} does not hold: {listing(lacking, 4)}; it "
                f"holds {listing(episodes, 4)}."
            )
        others = [name for name, success in rows.items() if episodes[name].attributes.success not in (None, success)]
        if others:
            recorded = [name for name in others if episodes[name].outcome is None]
            back = f"take back what was told: vla-attention store outcomes {path} --remove"
            raise BadArgument(
                f"{file} contradicts the outcome that {path} has of {listing(recorded or others, 4)}: "
                f"{'it was recorded, and stays' if recorded else back}."
            )
        new = [name for name in rows if episodes[name].attributes.success is None]
        given = {name: LaterOutcome(rows[name], episodes[name].captured) for name in new}
        write_outcomes(path, building, store.outcomes | given)
    return Told(len(new), len(rows) - len(new), unread)


def remove_outcomes(path: Path) -> None:
    """Take back all outcomes that were told after the recording.

    Raises:
        BadArgument: there are none.
    """
    with store_locks(path).part(WHOLE_STORE):
        if not (path / OUTCOMES_FILE).exists():
            raise BadArgument(f"{path} holds no outcomes that were told after its recording.")
        (path / OUTCOMES_FILE).unlink()


def _rows_of(file: Path) -> tuple[dict[str, bool], tuple[str, ...]]:
    """Outcomes by the episode's name, and the columns that were not read."""
    try:
        with file.open(encoding="utf-8-sig", newline="") as lines:
            table = csv.DictReader(lines)
            columns = tuple(name.strip() for name in table.fieldnames or ())
            table.fieldnames = list(columns)
            if twice := [name for name in COLUMNS if columns.count(name) > 1]:
                raise BadArgument(f"{file} has the column {listing(twice)} more than once.")
            if missing := [name for name in COLUMNS if name not in columns]:
                raise BadArgument(
                    f"{file} has no column {listing(missing)}; expected {listing(COLUMNS)}, found {listing(columns)}."
                )
            found: dict[str, bool] = {}
            for line, name, success in _parsed(file, table):
                if name in found:
                    raise BadArgument(f"{file} has two rows of {name} (the second in line {line}); give one each.")
                found[name] = success
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise BadArgument(f"Cannot read {file}: {getattr(error, 'strerror', None) or error}.") from None
    if not found:
        raise BadArgument(f"{file} has no rows; expected one per episode with {listing(COLUMNS)}.")
    return found, tuple(name for name in columns if name not in COLUMNS)


def _parsed(file: Path, table: csv.DictReader[str]) -> Iterator[tuple[int, str, bool]]:
    """Line, the episode's name and its outcome, of each row."""
    for row in table:
        task, index, success = (str(row[name] or "").strip() for name in COLUMNS)
        if None in row or not (_NUMBER.fullmatch(task) and _NUMBER.fullmatch(index) and success.casefold() in _VALUES):
            raise BadArgument(
                f"Line {table.line_num} of {file} has task_id '{task}', episode_index '{index}' and success "
                f"'{success}'; expected as many values as columns, two whole numbers and {listing(_VALUES)}; leave out "
                "rows of episodes whose outcome is not known."
            )
        yield table.line_num, episode_name(int(task), int(index)), _VALUES[success.casefold()]
