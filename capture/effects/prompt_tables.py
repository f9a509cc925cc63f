"""Tables of other prompts for the tasks of a run: read from a file, or made of the tasks and of the table we ship."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any, get_args

from vla_attention.capture.effects.arguments import STANDARD, TABLE, EffectSettings
from vla_attention.capture.effects.conditions import exchanges
from vla_attention.capture.effects.measurement import siblings_of
from vla_attention.capture.environments.suites import find_suite, list_tasks
from vla_attention.capture.interventions.condition_name import plain
from vla_attention.capture.interventions.prompts import with_synonyms
from vla_attention.schemas.effects import OtherPrompt
from vla_attention.schemas.errors import BadArgument, UserError, listing, unknown_name
from vla_attention.schemas.foreign_files import decode_toml, read_regular
from vla_attention.schemas.groupings.words import folded_words, word_class
from vla_attention.schemas.interventions import PromptKind
from vla_attention.schemas.safe_text import check_text

#: Our own tables, SUITE.csv: two paraphrases and a contradiction of each task.
SHIPPED = Path(__file__).parent / "prompts"
COLUMNS = ("task", "sentence", "kind")
#: Thousands of sentences have some hundred thousand bytes. The table becomes a part of the store's root.
_MOST_BYTES = 1_000_000
#: So a spreadsheet's formula begins, and sentences are written into tables that spreadsheets open.
_FORMULA = ("=", "+", "-", "@")
_WRITTEN_OTHERWISE = "written otherwise"
#: Sentences of other tasks that a task is told.
_OTHERS = 3


def with_rows(
    effects: EffectSettings | None,
    suite: str,
    tasks: Sequence[tuple[int, str, str]],
    scenes: Mapping[int, Mapping[int, str]] | None = None,
) -> EffectSettings | None:
    """Return the settings with the rows of their prompt table.

    Args:
        effects: what is measured.
        suite: of the run; all of its tasks are known where it is one of ours.
        tasks: number, instruction and family of the run's tasks.
        scenes: by task the instructions of the tasks that share its scene, by number, where that is known.

    Raises:
        BadArgument: the table cannot be read, or has no row for the run's tasks.
    """
    if effects is None or not effects.prompts:
        return effects
    known = {}
    with suppress(UserError):  # tasks of the caller's own, or LIBERO is not installed
        known = {one.task_id: (one.task_id, one.instruction, one.task_family) for one in list_tasks(find_suite(suite))}
    known |= {task[0]: task for task in tasks}
    instructions = {number: text for number, text, _ in known.values()}
    if effects.prompts == STANDARD:
        rows = [*_made_of(list(known.values()), scenes or {}), *shipped_prompts(suite, instructions)]
    else:
        rows = read_prompt_table(Path(effects.prompts.removeprefix(TABLE)), instructions)
    own = {number for number, _, _ in tasks}
    chosen = tuple(row for row in rows if row.task_id in own)
    if not chosen:
        raise BadArgument(
            f"The table of --prompts {effects.prompts} has no row for the tasks of the run, {listing(sorted(own))}; it "
            f"has rows for {listing(sorted({row.task_id for row in rows}))}."
        )
    return replace(effects, rows=chosen)


def _made_of(tasks: Sequence[tuple[int, str, str]], scenes: Mapping[int, Mapping[int, str]]) -> Iterator[OtherPrompt]:
    """The rows that need no table: the same words in another case or with a full stop, no words, shuffled ones, one
    exchanged, and those of the next tasks of the scene.
    """
    siblings, all_tasks = siblings_of(tasks), {number: text for number, text, _ in tasks}
    for number, instruction, _ in tasks:
        yield from (OtherPrompt(number, "written otherwise", sentence) for sentence in _written_otherwise(instruction))
        yield from (OtherPrompt(number, "empty"), OtherPrompt(number, "shuffled"))
        told = {folded_words(instruction)}
        for change in exchanges(instruction, siblings[number]):
            sentence, ((word, other),) = with_synonyms(instruction, change.synonyms), change.synonyms.items()
            # 'the' for 'and', or a word that stands there twice, makes no sentence.
            if {word_class(word), word_class(other)} == {"content"} and folded_words(instruction).count(word) == 1:
                told.add(folded_words(sentence))
                yield OtherPrompt(number, "exchanged", sentence)
        sharing = {other: text for other, text in scenes.get(number, {}).items() if folded_words(text) not in told}
        others = sharing or {other: text for other, text in all_tasks.items() if folded_words(text) not in told}
        nearest = sorted(others, key=lambda other: (other < number, other))[:_OTHERS]  # behind it, then from the first
        yield from (OtherPrompt(number, "other task", others[other]) for other in nearest)


def _written_otherwise(instruction: str) -> tuple[str, ...]:
    """The sentence with a full stop, or without its own, and with a capital, or without its own.

    >>> _written_otherwise("open it")
    ('open it.', 'Open it')
    """
    turned = instruction[:1].swapcase() + instruction[1:]
    stopped = instruction[:-1] if instruction.endswith(".") else f"{instruction}."
    return (stopped, turned) if turned != instruction else (stopped,)


def shipped_prompts(suite: str, instructions: Mapping[int, str]) -> Iterator[OtherPrompt]:
    """The rows of our table of a suite that are of tasks with one of these instructions; none without a table."""
    path = SHIPPED / f"{suite}.csv"
    for _, row in _rows_of(path) if path.is_file() else ():
        yield from (OtherPrompt(one, row["kind"], row["sentence"]) for one in _tasks_of(row["task"], instructions))


def read_prompt_table(path: Path, instructions: Mapping[int, str]) -> list[OtherPrompt]:
    """Read a table, CSV or TOML, of sentences for tasks that have these instructions, by number.

    Raises:
        BadArgument: something is wrong with the file or with a row; names the line, what was expected and what exists.
    """
    # Conditions are told apart by their names, in which commas and hyphens are alike.
    found: dict[tuple[int, str | tuple[str, ...], bool], str] = {}
    rows = []
    for where, row in _rows_of(path):
        kinds, sentence = get_args(PromptKind), row["sentence"]
        numbers = _tasks_of(row["task"], instructions)
        try:
            if not numbers:
                raise unknown_name("task", row["task"], [f"{n} ({text})" for n, text in instructions.items()])
            if row["kind"] not in kinds:
                raise unknown_name("kind of prompt", row["kind"], kinds)
            check_text("sentence", sentence)
            if sentence.startswith(_FORMULA):
                raise BadArgument(f"'{sentence}' begins as a formula of a spreadsheet; expected words.")
            for number in numbers:
                own, kind = instructions[number], row["kind"]
                same_words = folded_words(sentence) == folded_words(own)
                if kind != "empty" and (same_words != (kind == _WRITTEN_OTHERWISE) or sentence == own):
                    raise BadArgument(
                        f"'{sentence}' is no '{kind}' sentence of task {number}, '{own}': '{_WRITTEN_OTHERWISE}' has "
                        "the same words in another case or punctuation, and every other kind has other words."
                    )
                key = number, plain(sentence) if same_words else folded_words(plain(sentence)), kind == "empty"
                if key in found:
                    raise BadArgument(f"Task {number} has the same words in {found[key]}; expected each once.")
                found[key] = where
                rows.append(OtherPrompt(number, row["kind"], sentence))
        except UserError as error:
            raise BadArgument(f"{path}, {where}: {error}") from None
    return rows


def _tasks_of(given: str, instructions: Mapping[int, str]) -> list[int]:
    """The tasks of that number, or with that instruction."""
    words = folded_words(given)
    return [number for number, text in instructions.items() if given == str(number) or folded_words(text) == words]


def _rows_of(path: Path) -> Iterator[tuple[str, dict[str, Any]]]:
    """Where each row of a table stands, and its columns, with white space around them taken off."""
    try:
        text = read_regular(path, _MOST_BYTES).decode("utf-8-sig")
        rows = list(_toml_rows(text) if path.suffix == ".toml" and text else _csv_rows(text))
    except (OSError, ValueError, csv.Error) as error:
        reason = error.strerror if isinstance(error, OSError) else error
        raise BadArgument(f"Cannot read the prompt table {path} ({reason}); expected CSV or TOML in UTF-8.") from None
    if not rows:
        raise BadArgument(f"The prompt table {path} has no row; expected {listing(COLUMNS)} in each.")
    for where, row in rows:
        if set(row) != set(COLUMNS) or not all(isinstance(value, str | int) for value in row.values()):
            given = listing([str(name) for name, value in row.items() if value is not None])
            raise BadArgument(f"{path}, {where}: it has the columns {given}; expected {listing(COLUMNS)}, each a text.")
        yield where, {name: str(value).strip() for name, value in row.items()}


def _csv_rows(text: str) -> Iterator[tuple[str, dict[Any, Any]]]:
    reader = csv.DictReader(io.StringIO(text), restkey="more cells than columns", strict=True)
    yield from ((f"line {reader.line_num}", row) for row in reader)


def _toml_rows(text: str) -> Iterator[tuple[str, dict[Any, Any]]]:
    content = decode_toml(text)
    rows = content.get("prompt")
    if set(content) != {"prompt"} or not isinstance(rows, list) or not all(isinstance(row, dict) for row in rows):
        raise ValueError("it is no list of [[prompt]]")
    yield from ((f"prompt {number}", row) for number, row in enumerate(rows, start=1))
