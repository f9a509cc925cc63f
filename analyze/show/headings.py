"""The parts that printed texts share: titles, headings, what was analysed, the warning of untrained weights, notes."""

from __future__ import annotations

import textwrap
from collections.abc import Iterable, Sequence

from vla_attention.analyze.show.numbers import of_tasks

#: Columns of every printed text. Only long instructions and paths may run over.
WIDTH = 100


def wrap(text: str, first: str = "", rest: str = "") -> list[str]:
    """Lines of at most `WIDTH` columns, none of an empty text.

    `first` and `rest` indent the first line and the others.
    """
    return textwrap.wrap(
        text, WIDTH, initial_indent=first, subsequent_indent=rest, break_long_words=False, break_on_hyphens=False
    )


def wrap_all(lines: Iterable[str], rest: str = "") -> list[str]:
    """Each line wrapped, see `wrap`."""
    return [part for line in lines for part in wrap(line, rest=rest)]


def title(text: str) -> list[str]:
    """The title of a whole text, with a double rule below it."""
    return [text, "=" * WIDTH]


def heading(text: str) -> str:
    """The heading of a section, with a rule below it."""
    return "\n".join([*wrap(text), "-" * WIDTH])


def untrained_sentence(whose: str) -> str:
    """What untrained weights mean for the numbers; `whose` begins the sentence: `The policy has`."""
    return (
        f"{whose} untrained (random) weights. These numbers show that the pipeline works; they say nothing about any "
        "policy."
    )


def untrained_warning(whose: str = "the policy has") -> str:
    """The warning that stands above all numbers of a policy with untrained weights."""
    return f"WARNING: {untrained_sentence(whose)}"


def run_header(
    text: str,
    *,
    stores: Sequence[object],
    untrained: bool,
    site: str,
    layer: str,
    num_episodes: int,
    num_tasks: int,
    notes: Sequence[str] = (),
) -> list[str]:
    """The first lines of a printed result: title, warning, stores, site, layer, numbers of episodes and tasks, notes.

    Args:
        text: the title.
        stores: paths of the stores.
        untrained: whether the weights are random.
        site: the softmax family.
        layer: which layer or mean of layers, as text.
        num_episodes: selected episodes.
        num_tasks: their tasks.
        notes: one line each, for instance on episodes that were left out.
    """
    lines = [
        f"Stores: {', '.join(str(store) for store in stores)}",
        f"Site '{site}', {layer}; {of_tasks(num_episodes, num_tasks)}",
        *notes,
    ]
    warning = [untrained_warning()] if untrained else []
    return [*title(text), *wrap_all([*warning, *lines])]
