"""The prompt of a replan: its token pieces from token ids, and the roles of its keys. Needs no torch.

The ids are those that the policy's own embedding was given: a second tokenization could differ.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vla_attention.capture.torch_policies.policy_layout import PolicyLayout, RecordedSite
from vla_attention.schemas.errors import BadArgument
from vla_attention.schemas.layout import ROLE_DTYPE, Piece, Prompt, Role, roles_from_spans
from vla_attention.schemas.safe_text import visible


class PromptDoesNotFit(BadArgument):
    """A prompt whose tokens are not the keys of the layout, or that does not contain the instruction."""


class TokenText:
    """The text of token ids, piece by piece; ids that stand for no text are known.

    tokenizer: has `decode`; of transformers' attributes `all_special_ids` and `bos_token_id` are used where they are.
    """

    def __init__(self, tokenizer: Any) -> None:
        if not callable(getattr(tokenizer, "decode", None)):
            raise BadArgument(
                f"A tokenizer of type {type(tokenizer).__name__} has no decode(ids) -> str; give the policy's own "
                "tokenizer, or replan(prompt=...)."
            )
        self.tokenizer = tokenizer
        self.special = {int(number) for number in getattr(tokenizer, "all_special_ids", ())}
        self.bos = getattr(tokenizer, "bos_token_id", None)
        self._decode = _plain_decode(tokenizer)
        self._known: dict[tuple[int, ...], tuple[str, tuple[tuple[int, int], ...]]] = {}

    def pieces(self, ids: Sequence[int]) -> tuple[str, tuple[tuple[int, int], ...]]:
        """Return the text of ids, and the characters [start, stop) of each.

        A piece may be part of a character only (bytes): it begins where the text of those before it ends.
        """
        key = tuple(ids)
        if key not in self._known:
            if len(self._known) > 1000:
                self._known.clear()
            text = self._decode(list(key))
            ends = [0]
            for count in range(1, len(key)):
                ends.append(max(ends[-1], _common(self._decode(list(key[:count])), text)))
            ends.append(len(text))
            self._known[key] = text, tuple(pairwise(ends))[: len(key)]
        return self._known[key]


def _common(text: str, other: str) -> int:
    """Number of characters at the beginning that are the same."""
    pairs = enumerate(zip(text, other, strict=False))
    return next((number for number, (a, b) in pairs if a != b), min(len(text), len(other)))


def _plain_decode(tokenizer: Any) -> Callable[[list[int]], str]:
    """The tokenizer's `decode` without a clean-up of spaces, where it has one."""

    def decode(ids: list[int]) -> str:
        if not ids:
            return ""
        try:
            return str(tokenizer.decode(ids, skip_special_tokens=False, clean_up_tokenization_spaces=False))
        except TypeError:
            return str(tokenizer.decode(ids))

    return decode


def text_keys(site: RecordedSite, spans: Sequence[str], present: NDArray[np.bool_] | None) -> list[int]:
    """Return the keys of the prompt's spans, in order; `present` (key,) bool leaves out keys that do not exist."""
    keys = [key for name in spans for key in range(site.keys.span(name).start, site.keys.span(name).stop)]
    return keys if present is None else [key for key in keys if present[key]]


def prompt_from_ids(
    ids: Sequence[int],
    keys: Sequence[int],
    tokenizer: TokenText,
    instruction: str,
    valid: NDArray[np.bool_] | None,
) -> Prompt:
    """Return the prompt of token ids and their keys, (token,) each.

    instruction: looked for in the text, whatever its case and spaces; empty: none. valid: (key,) bool, keys that the
    policy can see; None for all. Special tokens and keys that are not valid have no piece.

    Raises:
        PromptDoesNotFit: the numbers of ids and keys differ, or the instruction is not in the text.
    """
    if len(ids) != len(keys):
        raise PromptDoesNotFit(
            f"The policy embedded {len(ids)} text tokens, and the layout's prompt has {len(keys)} keys: change its "
            "spans, or its skip_ids (placeholders for patches)."
        )
    kept = [
        (token, key)
        for token, key in zip(ids, keys, strict=True)
        if token not in tokenizer.special and (valid is None or valid[key])
    ]
    text, ranges = tokenizer.pieces([token for token, _ in kept])
    pieces = tuple(Piece(key, text[a:b], a, b) for (_, key), (a, b) in zip(kept, ranges, strict=True))
    return Prompt(text, pieces, find_instruction(text, instruction))


def prompt_from_pieces(texts: Sequence[str | None], keys: Sequence[int], instruction: str) -> Prompt:
    """Return the prompt of pieces given as text, one for each key of the prompt; None or "" for keys without text."""
    if len(texts) != len(keys):
        raise PromptDoesNotFit(
            f"The prompt was given as {len(texts)} pieces, and the layout's prompt has {len(keys)} keys: give one "
            "piece for each key, None where it has no text."
        )
    text, pieces = "", []
    for piece, key in zip(texts, keys, strict=True):
        if piece:
            pieces.append(Piece(key, piece, len(text), len(text) + len(piece)))
            text += piece
    return Prompt(text, tuple(pieces), find_instruction(text, instruction))


def prompt_without_pieces(instruction: str) -> Prompt:
    """Return the prompt where no pieces are known: the instruction alone."""
    return Prompt(instruction, (), (0, len(instruction)))


def find_instruction(text: str, instruction: str) -> tuple[int, int]:
    """Return the characters [start, stop) of the instruction in a prompt, whatever its case and spaces.

    Policies write it in small letters, with spaces for underscores, or without its full stop.

    Raises:
        PromptDoesNotFit: it is not there.
    """
    words = re.split(r"[\s_]+", instruction.strip().rstrip(".").strip())
    if words == [""]:
        return 0, 0
    match = re.search(r"[\s_]+".join(re.escape(word) for word in words), text, re.IGNORECASE)
    if match is None:
        raise PromptDoesNotFit(
            f"The policy's prompt is '{visible(text)}', which does not contain the instruction "
            f"'{visible(instruction)}'; give replan(instruction=...) as the policy reads it, or an empty one."
        )
    return match.span()


def roles_of_keys(
    site: RecordedSite,
    layout: PolicyLayout,
    prompt: Prompt,
    present: NDArray[np.bool_] | None = None,
    valid: NDArray[np.bool_] | None = None,
    bos_key: int | None = None,
    given: Mapping[str, NDArray[np.uint8]] | None = None,
) -> NDArray[np.uint8]:
    """Return the role codes of a site's keys at one replan, (key,).

    Keys of the prompt are `instruction` inside the instruction's characters and `template` elsewhere, where pieces are
    known. Keys that exist in no call are `absent`; keys that no action query may see are `masked_image` or `padding`.

    Args:
        present: (key,) bool, keys that some call had; None for all.
        valid: (key,) bool, keys that some action query may see; None for all.
        bos_key: the key of the prompt's first special token.
        given: site -> (key,) roles that the caller gave instead.
    """
    if given is not None and site.name in given:
        roles = np.array(given[site.name], dtype=ROLE_DTYPE)
        if roles.shape != (site.keys.num_keys,):
            raise BadArgument(
                f"The roles given for site '{site.name}' have the shape {roles.shape}; expected one code for each of "
                f"{site.keys.num_keys} keys."
            )
    else:
        roles = roles_from_spans(site.keys, {span.name: site.role_of(span) for span in site.keys.spans})
        if layout.text is not None and prompt.pieces and site in layout.text_sites:
            keys = text_keys(site, layout.text.spans, None)
            roles[[key for key in keys if roles[key] == Role.INSTRUCTION]] = Role.TEMPLATE
            first, last = prompt.instruction
            for piece in prompt.pieces:
                inside = piece.start < last and piece.stop > first
                roles[piece.key] = Role.INSTRUCTION if inside else Role.TEMPLATE
            for piece in _state_pieces(prompt, layout.text.state_between):
                roles[piece.key] = Role.STATE
            if bos_key is not None:
                roles[bos_key] = Role.BOS
    for span in site.keys.spans:
        keys_of_span = slice(span.start, span.stop)
        if valid is not None:
            roles[keys_of_span][~valid[keys_of_span]] = site.masked_role(span)
        if present is not None:
            roles[keys_of_span][~present[keys_of_span]] = Role.ABSENT
    return roles


def _state_pieces(prompt: Prompt, around: tuple[str, str] | None) -> list[Piece]:
    """The pieces of the state that a policy writes into its prompt, after the instruction."""
    if around is None:
        return []
    before, after = around
    start = prompt.text.find(before, prompt.instruction[1])
    if start < 0:
        return []
    start += len(before)
    end = prompt.text.find(after, start)
    end = len(prompt.text) if end < 0 else end
    return [piece for piece in prompt.pieces if piece.start < end and piece.stop > start and piece.text.strip()]
