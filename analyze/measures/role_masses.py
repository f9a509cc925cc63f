"""How much attention the keys of each role get."""

from __future__ import annotations

import numpy as np

from vla_attention.analyze.measures.question import Question
from vla_attention.analyze.measures.steps import selected_cells


def role_masses(question: Question) -> dict[str, float]:
    """Mean mass of the keys of each role, by the role's name.

    Means over replans, selected layers, denoise steps, heads and queries, then over episodes. They come from the stored
    masses of segments, which are exact while stored rows are rounded. Their sum is the mean row sum (1).
    """
    selection = question.selection
    totals: dict[str, float] = {}
    for item in question.selected:
        atoms = selected_cells(item.episode.read(f"{question.site}/atoms"), selection)
        masses = atoms.reshape(-1, atoms.shape[-1]).mean(axis=0, dtype=np.float64)
        for segment, mass in zip(item.episode.attributes.segments[question.site], masses.tolist(), strict=True):
            totals[segment.role] = totals.get(segment.role, 0.0) + mass
    return {role: total / len(question.selected) for role, total in totals.items()}
