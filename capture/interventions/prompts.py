"""Another instruction than the task's: empty, shuffled, another task's, any text, or with synonyms."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path

import numpy as np

from vla_attention.schemas.errors import BadArgument, listing
from vla_attention.schemas.foreign_files import read_regular, read_toml
from vla_attention.schemas.groupings.words import folded_words, split_words
from vla_attention.schemas.interventions import PromptChange
from vla_attention.schemas.jsonable import decode_json


def changed_instruction(
    instruction: str, change: PromptChange, *, task_id: int, episode_index: int, instructions: Mapping[int, str]
) -> str:
    """Return the instruction that the policy gets instead.

    Args:
        instruction: of the episode.
        change: what is changed.
        task_id, episode_index: of the episode; with the change's seed they decide the order of shuffled words, so that
            all replans of an episode have the same.
        instructions: of the tasks that a change to another task may name, by task id.

    Raises:
        BadArgument: there is no instruction of the task that the change names.
    """
    if change.kind == "empty":
        return ""
    if change.kind == "text":
        return change.text
    if change.kind == "synonyms":
        return with_synonyms(instruction, change.synonyms)
    if change.kind == "shuffled":
        return shuffled(instruction, np.random.default_rng([change.seed, task_id, episode_index]))
    if change.task_id is None or change.task_id not in instructions:
        raise BadArgument(
            f"There is no instruction of task {change.task_id}; those of the tasks {listing(sorted(instructions))} are "
            "known."
        )
    return instructions[change.task_id]


def shuffled(instruction: str, generator: np.random.Generator) -> str:
    """Return the words (parted by spaces) in another order; the same text only if all of its words are the same."""
    words = instruction.split()
    if len(set(words)) < 2:
        return instruction
    while True:
        order = [words[i] for i in generator.permutation(len(words))]
        if order != words:
            return " ".join(order)


def with_synonyms(instruction: str, synonyms: Mapping[str, str]) -> str:
    """Return the text with words replaced; upper and lower case are the same, and all other characters stay."""
    by_word = {word.casefold(): synonym for word, synonym in synonyms.items()}
    parts, position = [], 0
    for start, stop in split_words(instruction):
        synonym = by_word.get(instruction[start:stop].casefold())
        if synonym is not None:
            parts += [instruction[position:start], synonym]
            position = stop
    return "".join([*parts, instruction[position:]])


def check_synonyms(change: PromptChange, instructions: Iterable[str]) -> None:
    """Raise `BadArgument` for a word with a synonym that no instruction has."""
    words = {word for text in instructions for word in folded_words(text)}
    for word in change.synonyms:
        if word.casefold() not in words:
            raise BadArgument(
                f"No instruction has the word '{word}', for which a synonym is given; words: "
                f"{listing(sorted(words), 40)}."
            )


def read_synonyms(path: Path) -> dict[str, str]:
    """Read a JSON object or a TOML table of words and what replaces them; the ending of the name says which."""
    try:
        content = read_toml(path) if path.suffix == ".toml" else decode_json(read_regular(path))
    except (OSError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) else error
        raise BadArgument(f"Cannot read the synonyms '{path}' ({reason}); expected JSON or TOML.") from None
    if not isinstance(content, dict) or not content or not all(isinstance(value, str) for value in content.values()):
        raise BadArgument(f'The synonyms \'{path}\' are no table; expected for instance {{"bowl": "dish"}}.')
    several = [word for word in content if len(split_words(word)) != 1]
    if several:
        raise BadArgument(f"The synonyms '{path}' give one for '{several[0]}', which is not a single word.")
    return dict(content)
