"""The sentence that says which of many may be named after looking at all of them."""

from __future__ import annotations

from collections.abc import Sequence

from vla_attention.analyze.show.numbers import plural
from vla_attention.analyze.statistics.many_looks import NAMED_AT
from vla_attention.schemas.errors import listing


def findings(
    q_values: Sequence[float | None], names: Sequence[str], kind: str, what: str, num_sentences: int = 1
) -> str:
    """`Of 10 tasks, 2 show a difference (q <= 0.05): task 3, task 7.`, or that none does.

    Args:
        q_values: adjusted p-values (`many_looks.adjusted_p_values`), one per name; None is never named.
        names: what could be named.
        kind: what they are, singular: "task".
        what: what they show: "a difference".
        num_sentences: such sentences in the text; the level is shared out between them, so that a text about nothing
            names anything in at most 5 % of cases.
    """
    level = NAMED_AT / num_sentences
    tested = [q for q in q_values if q is not None]
    if not tested:
        return f"None of {plural(len(names), kind)} can be tested."
    found = [name for name, q in zip(names, q_values, strict=True) if q is not None and q <= level]
    shared = f": {NAMED_AT:g} shared by {num_sentences} sentences" if num_sentences > 1 else ""
    bound = f"(q <= {level:g}{shared})"
    if not found:
        return f"Of {plural(len(tested), kind)}, none shows {what} {bound}."
    verb = "shows" if len(found) == 1 else "show"
    return f"Of {plural(len(tested), kind)}, {len(found)} {verb} {what} {bound}: {listing(found, 8)}."
