"""The sentence that says which of many may be named after looking at all of them."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from vla_attention.analyze.show.numbers import plural
from vla_attention.analyze.statistics.many_looks import NAMED_AT
from vla_attention.schemas.errors import listing


def findings(
    q_values: Iterable[float | None], names: Sequence[str], kind: str, verb: str, num_sentences: int = 1
) -> str:
    """`Of 10 tasks, 2 differ (q <= 0.05): task 3, task 7.`, or that none does.

    Args:
        q_values: adjusted p-values (`many_looks.adjusted_p_values`), one per name; None is never named.
        names: what could be named.
        kind: what they are, singular: "task".
        verb: what they do, plural: "differ".
        num_sentences: such sentences in the text; the level is shared out between them, so that a text about nothing
            names anything in at most 5 % of cases.
    """
    level = NAMED_AT / num_sentences
    found = [name for name, q in zip(names, q_values, strict=True) if q is not None and q <= level]
    bound = f"(q <= {level:g})"
    if not found:
        return f"Of {plural(len(names), kind)}, none {verb}s {bound}."
    return f"Of {plural(len(names), kind)}, {len(found)} {verb}{'s' * (len(found) == 1)} {bound}: {listing(found, 8)}."
