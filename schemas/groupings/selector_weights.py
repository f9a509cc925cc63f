"""The weights of one selector on the keys of each site, for interventions.

A policy may have several sites, and a name may exist at one of them only: Cosmos reads words at `cross` and pictures at
`self`. A part of a selector takes no key at a site that does not have its name.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from vla_attention.schemas.errors import UserError, shortened
from vla_attention.schemas.groupings.resolve import weights_of
from vla_attention.schemas.groupings.selector_parser import (
    Atom,
    Everything,
    Operation,
    Selector,
    atoms_of,
    folded,
    parse_selector,
)
from vla_attention.schemas.groupings.selectors import SELECTOR_KINDS, SelectorError
from vla_attention.schemas.groupings.vocabulary import EpisodeTokens, Vocabulary

#: A selector that takes no key.
_NOTHING = Operation("-", Everything(), Everything())


def check_selector(text: str, vocabularies: Mapping[str, Vocabulary]) -> None:
    """Raise `SelectorError` for a selector that cannot be read, or for its first name that no site has.

    vocabularies: site -> the names at that site.
    """
    for atom in dict.fromkeys(atoms_of(parse_selector(text))):
        problems = {site: _problem(atom, vocabulary) for site, vocabulary in vocabularies.items()}
        unusable = {site: problem for site, problem in problems.items() if problem}
        if len(unusable) == len(problems):
            # A site with such keys says which names exist; the others only that they have none.
            telling = [
                problem for site, problem in unusable.items() if SELECTOR_KINDS[atom.kind].has_keys(vocabularies[site])
            ]
            raise SelectorError(f"Selector '{shortened(text)}': {(telling or list(unusable.values()))[0]}")


def selector_weights(
    text: str, tokens: Mapping[str, EpisodeTokens], vocabularies: Mapping[str, Vocabulary]
) -> dict[str, NDArray[np.float64]]:
    """Weight of every key in a selector's group, by site: (replan or 1, key) in 0..1.

    A site that has none of the selector's names gets no key, whatever `*` would take. Raises as `check_selector`.

    Args:
        text: the selector.
        tokens: site -> the episode's (or one replan's) tokens.
        vocabularies: site -> names that exist in the run; a name that these replans lack gives a group without keys.
    """
    check_selector(text, vocabularies)
    selector = parse_selector(text)
    weights: dict[str, NDArray[np.float64]] = {}
    for site, episode_tokens in tokens.items():
        known = [atom for atom in atoms_of(selector) if not _problem(atom, vocabularies[site])]
        if known or not atoms_of(selector):
            weights[site] = weights_of(_only(selector, known), episode_tokens).astype(np.float64)
        else:
            weights[site] = np.zeros((1, episode_tokens.layout.num_keys))
    return weights


def _problem(atom: Atom, vocabulary: Vocabulary) -> str | None:
    try:
        return SELECTOR_KINDS[atom.kind].problem(atom.argument, vocabulary)
    except UserError as error:
        return str(error)


def _only(selector: Selector, known: list[Atom]) -> Selector:
    """The selector with `_NOTHING` in place of the parts that are not known."""
    existing = set(known)

    def leaf(part: Atom | Everything) -> Selector:
        return part if isinstance(part, Everything) or part in existing else _NOTHING

    return folded(selector, leaf, Operation)
