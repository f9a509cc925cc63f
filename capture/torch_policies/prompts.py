"""The text of a prompt: of token ids piece by piece, and where the instruction and the state are in it."""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from functools import lru_cache
from itertools import pairwise
from typing import Any

from vla_attention.schemas.errors import BadArgument
from vla_attention.schemas.layout import Piece, Prompt
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
        self.pieces = lru_cache(maxsize=1000)(self._pieces)

    def _pieces(self, ids: tuple[int, ...]) -> tuple[str, tuple[tuple[int, int], ...]]:
        """Return the text of ids, and the characters [start, stop) of each.

        A piece may be part of a character only (bytes): it begins where the text of those before it ends.
        """
        text, ends = self._decoded(ids) if ids else "", [0]
        for count in range(1, len(ids)):
            same = os.path.commonprefix([self._decoded(ids[:count]), text])  # noqa: RUF071 - character by character
            ends.append(max(ends[-1], len(same)))
        return text, tuple(pairwise([*ends, len(text)]))[: len(ids)]

    def _decoded(self, ids: Sequence[int]) -> str:
        """The text of ids without a clean-up of spaces, where the tokenizer has one."""
        try:
            return str(self.tokenizer.decode(list(ids), skip_special_tokens=False, clean_up_tokenization_spaces=False))
        except TypeError:
            return str(self.tokenizer.decode(list(ids)))


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


def state_pieces(prompt: Prompt, around: tuple[str, str]) -> list[Piece]:
    """The pieces of the state that a policy writes into its prompt, after the instruction, between two texts."""
    before, after = map(re.escape, around)
    match = re.compile(rf"{before}(.*?)(?:{after}|\Z)", re.DOTALL).search(prompt.text, prompt.instruction[1])
    start, stop = match.span(1) if match else (0, 0)
    return [piece for piece in prompt.pieces if piece.start < stop and piece.stop > start and piece.text.strip()]
