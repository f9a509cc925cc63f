"""The first lines of a printed answer: what was asked of how much, and what must be known before believing it."""

from __future__ import annotations

import textwrap

from vla_attention.analyze.measures.aggregate import LAYERS_AVG
from vla_attention.analyze.measures.question import Question
from vla_attention.analyze.show.plot_style import plural

WIDTH = 100


def header(question: Question, heading: str, layer: str) -> list[str]:
    """Heading, a warning for untrained weights, stores, site, layer, numbers of episodes and tasks, and what was left out."""
    tasks = {(item.store.suite, item.episode.attributes.task_id) for item in question.selected}
    lines = [heading]
    if any(store.attributes.policy.untrained for store in question.stores):
        lines.append("WARNING: the policy has untrained (random) weights; these numbers say nothing about any policy.")
    lines += [
        f"Stores: {', '.join(str(store.path) for store in question.stores)}",
        f"Site '{question.site}', {'all layers' if layer == LAYERS_AVG else f'layer {layer}'}; "
        f"{plural(len(question.selected), 'episode')} of {plural(len(tasks), 'task')}",
        *question.skipped,
    ]
    return [part for line in lines for part in textwrap.wrap(line, WIDTH, break_long_words=False)]
