"""Which tasks of the selected episodes are related, and what that means for intervals over several tasks."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from vla_attention.analyze.measures.selected import SelectedEpisode
from vla_attention.analyze.statistics.units import Estimand, Sampling
from vla_attention.schemas.errors import UserError, listing
from vla_attention.schemas.safe_text import visible


class MixedFamilies(UserError, ValueError):
    """A task that is of one family in some episodes and of another one in others."""


def sampling_of(estimand: Estimand, selected: Iterable[SelectedEpisode]) -> Sampling:
    """What intervals are about, with the families that the episodes know of their tasks.

    A task has the family that any of its episodes knows: one store may be older than the next.

    Raises:
        MixedFamilies: episodes of a task know different ones, and intervals are by families.
    """
    families: dict[tuple[str, int], str] = {}
    for item in selected:
        family, task = item.episode.attributes.task_family, item.task
        known = families.setdefault(task, family) if family else ""
        if known != family and estimand == Estimand.TASKS_LIKE_THESE:
            raise MixedFamilies(
                f"Episodes of task {task[1]} of {task[0]} are of the task families '{visible(known)}' and "
                f"'{visible(family)}' (the latter: {item.episode.name} of {item.store.path}); a task has one family. "
                "Record them again with one, or choose --intervals these-tasks."
            )
    return Sampling(estimand, families)


def unknown_families(sampling: Sampling, selected: Sequence[SelectedEpisode]) -> str:
    """That intervals count tasks that seem related as independent, because their families are not known; or nothing."""
    if sampling.estimand != Estimand.TASKS_LIKE_THESE:
        return ""
    instructions = {item.task: visible(item.episode.attributes.instruction) for item in selected}
    said = related_instructions([text for task, text in instructions.items() if task not in sampling.families])
    return f"{said} --intervals these-tasks does not count them so." if said else ""


def related_instructions(instructions: Sequence[str]) -> str:
    """That tasks with these instructions, of which no family is known, seem related; empty where they do not."""
    number, examples = alike_instructions(instructions)
    if not number:
        return ""
    quoted = listing([f"'{text}'" for text in examples], 4)
    return (
        f"Of {len(instructions)} tasks no family is known, and {number} of their instructions differ in at most one "
        f"word from another one ({quoted}). Such tasks are related: intervals that count them as independent are too "
        "narrow."
    )


def alike_instructions(instructions: Sequence[str]) -> tuple[int, tuple[str, ...]]:
    """How many instructions differ in at most one word from another one, and the first two that do.

    Words are compared without case. Equal instructions differ in none.
    """
    places: dict[tuple[str, ...], list[int]] = {}
    for number, text in enumerate(instructions):
        words = text.casefold().split()
        # Equal but for one word: equal without it, at the same place.
        for i in range(len(words)):
            places.setdefault((str(i), *words[:i], *words[i + 1 :]), []).append(number)
    groups = [group for group in places.values() if len(group) > 1]
    examples = dict.fromkeys(instructions[number] for number in min(groups, default=[])[:2])
    return len({number for group in groups for number in group}), tuple(examples)
