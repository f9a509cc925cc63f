"""Every word of the instructions as an item that is measured."""

from __future__ import annotations

import numpy as np
import polars as pl

from vla_attention.analyze.core.measure import Items
from vla_attention.analyze.measures.selected import SelectedEpisode
from vla_attention.schemas.groupings.words import word_class
from vla_attention.schemas.layout import Role

#: The roles of language: the linguistic group of the grouping 'default'. State digits are text, but not language.
LANGUAGE = (Role.BOS, Role.TEMPLATE, Role.INSTRUCTION, Role.TEXT)
#: Measured beside the words, for scale, where the site has such keys.
SCALE = {
    Role.BOS: "first token",
    Role.TEMPLATE: "fixed words of the prompt",
    Role.TEXT: "other text",
    Role.STATE: "state digits",
    Role.IMAGE: "image patches",
    Role.BORDER: "border of pictures",
}
LABELS = {"kind": pl.String, "item": pl.String, "place": pl.Int64, "word_class": pl.String}


def items_of(item: SelectedEpisode) -> Items:
    """Every word of the prompts and every place of a word, content and stop words, and the keys of some roles.

    `kind` is "word" (all places of a word together), "place" (a word at its place in the instruction, from 0) or
    "scale". A share is of the mass of all language; state digits and patches have none.
    """
    tokens = item.tokens
    num_keys, roles = tokens.layout.num_keys, tokens.static_roles
    members: dict[tuple[str, str, int | None, str | None], int] = {}
    cells: list[tuple[int, int, int]] = []
    # Most prompts differ in the state's digits alone, and have the same words.
    lines = {line: number for number, line in enumerate(dict.fromkeys(tokens.words))}
    for words, number in lines.items():
        for place, word in enumerate(words):
            text, of_class = word.text.casefold(), word_class(word.text)
            for name in (
                ("word", text, None, of_class),
                ("place", text, place, of_class),
                ("scale", f"{of_class} words", None, of_class),
            ):
                item_number = members.setdefault(name, len(members))
                cells += [(number, key, item_number) for key in word.keys]
    named = [role for role in SCALE if (roles == role).any() or (role == Role.BORDER and tokens.has_cut_patches)]
    at = (
        np.zeros(1, np.intp)
        if len(lines) < 2
        else np.array([lines[words] for words in tokens.words])[tokens.prompt_index]
    )
    weights = np.zeros((max(len(at), len(roles)), num_keys, len(members) + len(named)), np.float32)
    if cells:
        of_words = np.zeros((len(lines), num_keys, len(members)), np.float32)
        of_words[tuple(np.array(cells).T)] = 1.0
        weights[..., : len(members)] = of_words[at]
    for i, role in enumerate(named, len(members)):
        if tokens.border is None or role not in (Role.IMAGE, Role.BORDER):
            weights[..., i] = roles == role
        else:
            seen = np.isin(roles, (Role.IMAGE, Role.BORDER))
            weights[..., i] = seen * (tokens.border if role == Role.BORDER else 1.0 - tokens.border)
    names = [*members, *(("scale", SCALE[role], None, None) for role in named)]
    labels = {
        column: pl.Series(column, [name[i] for name in names], dtype=dtype)
        for i, (column, dtype) in enumerate(LABELS.items())
    }
    return Items(labels, weights, np.isin(roles, [int(role) for role in LANGUAGE]))
