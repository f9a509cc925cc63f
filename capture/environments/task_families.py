"""Families of tasks by sentence template: the instruction, with a letter for everything that names an object.

Tasks of one template are related: what a policy does with one says much about the others, and statistics do not count
them as independent (docs/statistics.md). Needs no simulator.
"""

from __future__ import annotations

import re

#: Expressions that mean the same are one template.
_SAME = (
    ("on top of", "on"),
    ("and put it", "and place it"),
    ("and put the bowl inside", "and put the bowl in it"),
    ("and put the cream cheese inside", "and put the cream cheese in it"),
    ("pick the", "pick up the"),
)
#: The templates of LIBERO's suites and of robosuite's tasks. The first one that fits is the family, so that those with
#: a second clause stand before those without.
TEMPLATES = (
    "put both A and B in C",
    "put both A on B",
    "put A in B and close it",
    "put A on B and put C on D",
    "put A on B and put C to the right of D",
    "put A to the front of B",
    "put A to the left of B",
    "put A to the right of B",
    "put A under B",
    "open A and put B in it",
    "open A",
    "close A and put B on it",
    "close A and open B",
    "close A",
    "turn on A and put B on it",
    "turn on A",
    "turn off A",
    "push A to the front of B",
    "stack A on B and place them in C",
    "stack A on B",
    "pick up A and place it in B",
    "pick up A and place it on B",
    "pick up A and place it under B",
    "pick up A and place it to the right of B",
    "put A in B",
    "put A on B",
    "lift A",
)
_PATTERNS = {template: re.compile(re.sub(r"\b[A-D]\b", ".+", template)) for template in TEMPLATES}


def sentence_template(instruction: str) -> str:
    """The first of `TEMPLATES` that an instruction fits; empty where none does: no family is known."""
    words = instruction
    for given, same in _SAME:
        words = words.replace(given, same)
    return next((template for template, pattern in _PATTERNS.items() if pattern.fullmatch(words)), "")
