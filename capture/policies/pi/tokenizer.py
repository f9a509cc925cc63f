"""Tokenize instruction and state into a prompt, with the role and the characters of every token.

Prompt formats are openpi's and LeRobot's, whose tokenizer is PaliGemma's sentencepiece model. Roles come from character
offsets, not from a search for token ids, because an instruction may contain the word "State".
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from vla_attention.capture.policies.checkpoints import UnreadableCheckpoint
from vla_attention.capture.policies.pi.config import PALIGEMMA_VOCABULARY
from vla_attention.capture.policies.sentencepiece_model import SentencepieceModel, Token
from vla_attention.schemas.errors import BadArgument
from vla_attention.schemas.layout import ROLE_DTYPE, Piece, Prompt, Role

#: Pieces of Gemma's vocabulary, the first part of PaliGemma's.
GEMMA_VOCABULARY = 256_000

#: `instruction-newline`: openpi without state, "\n" encoded on its own. `task-state-action`: pi0.5 with the state as
#: digits, "Task: {instruction}, State: {bins};\nAction: ", in both ecosystems. `raw-instruction-newline` and
#: `raw-instruction`: LeRobot's pi0, the unchanged instruction, encoded as one string with or without "\n" at its
#: end.
PromptFormat = Literal["instruction-newline", "task-state-action", "raw-instruction-newline", "raw-instruction"]


@dataclass(frozen=True)
class TokenizedPrompt:
    """A prompt for the model, padded to its text slots.

    ids: (text,) int64; mask: (text,) bool, True = a real token; roles: (text,) uint8 codes of `Role`; prompt: the text
    given to the model, its pieces with their keys, and the range of the instruction. num_cut: number of tokens that
    were cut off; the prompt's text is complete, and its last pieces are missing.
    """

    ids: NDArray[np.int64]
    mask: NDArray[np.bool_]
    roles: NDArray[np.uint8]
    prompt: Prompt
    num_cut: int = 0


@dataclass(frozen=True)
class _Section:
    """A part of the prompt with one role; `encode_alone` starts a new encoder call with it."""

    text: str
    role: Role
    encode_alone: bool = False


def clean_instruction(instruction: str) -> str:
    """Return the instruction as openpi cleans it: stripped, with spaces for "_" and newlines."""
    return instruction.strip().replace("_", " ").replace("\n", " ")


def digitise_state(state: NDArray[np.floating]) -> NDArray[np.int64]:
    """Return the bin of each normalised state value, (state,): 0..255 over [-1, 1), 255 above, -1 below.

    openpi's formula gives -1, so its policies were trained with it.
    """
    bins: NDArray[np.int64] = np.digitize(state, np.linspace(-1, 1, 256 + 1)[:-1]) - 1
    return bins


class PromptTokenizer:
    """A sentencepiece model and openpi's prompt formats."""

    def __init__(self, model_path: str | Path):
        needed = "pi policies need PaliGemma's sentencepiece model (paligemma_tokenizer.model)"
        self.model = SentencepieceModel(model_path, needed)
        #: SHA-256 (hex) of the file
        self.digest = self.model.digest
        if self.model.bos_id < 0:
            raise UnreadableCheckpoint(
                f"The tokenizer '{model_path}' has no BOS token, which every pi prompt starts with."
            )

    @property
    def vocab_size(self) -> int:
        """Number of ids; the model's table must have at least as many rows."""
        return self.model.vocab_size

    def tokenize(
        self,
        instruction: str,
        *,
        max_token_len: int,
        first_key: int = 0,
        state: NDArray[np.floating] | None = None,
        prompt_format: PromptFormat | None = None,
        cut: bool = False,
    ) -> TokenizedPrompt:
        """Tokenize an instruction, and the state if the format contains it.

        Args:
            instruction: of the task; cleaned if the format does so.
            max_token_len: text slots of the model.
            first_key: key of the first text slot, for the pieces.
            state: (state,) normalised, unpadded.
            prompt_format: None takes openpi's, with the state if there is one.
            cut: cut a longer prompt as the reference implementations do, instead of refusing it as a `BadArgument`.
        """
        if prompt_format is None:
            prompt_format = "instruction-newline" if state is None else "task-state-action"
        sections = _sections(instruction, state, prompt_format)
        tokens = self._encode(sections)
        num_cut = max(0, 1 + len(tokens) - max_token_len)
        if num_cut and not cut:
            raise BadArgument(
                f"The prompt of the instruction '{instruction}' has {1 + len(tokens)} tokens, but the model has room "
                f"for {max_token_len}; shorten the instruction."
            )
        text = "".join(section.text for section in sections)
        role_of_character = [section.role for section in sections for _ in section.text]
        tokens = tokens[: len(tokens) - num_cut]
        length = 1 + len(tokens)
        ids = np.zeros(max_token_len, dtype=np.int64)
        mask = np.arange(max_token_len) < length
        roles = np.full(max_token_len, Role.PADDING, dtype=ROLE_DTYPE)
        ids[0], roles[0] = self.model.bos_id, Role.BOS
        ids[1:length] = [token.id for token in tokens]
        roles[1:length] = [_role(token, text, role_of_character) for token in tokens]
        pieces = tuple(
            Piece(key=first_key + slot, text=token.piece, start=token.start, stop=token.stop)
            for slot, token in enumerate(tokens, start=1)
        )
        # The sections before the instruction; an empty instruction has a place, too.
        before = itertools.takewhile(lambda section: section.role is not Role.INSTRUCTION, sections)
        start = sum(len(section.text) for section in before)
        prompt = Prompt(text, pieces, (start, start + role_of_character.count(Role.INSTRUCTION)))
        return TokenizedPrompt(ids=ids, mask=mask, roles=roles, prompt=prompt, num_cut=num_cut)

    def _encode(self, sections: Sequence[_Section]) -> list[Token]:
        """Encode the sections together, except those that are encoded alone; offsets refer to the whole text."""
        calls: list[str] = []
        for section in sections:
            if section.encode_alone or not calls:
                calls.append(section.text)
            else:
                calls[-1] += section.text
        tokens: list[Token] = []
        offset = 0
        for call in calls:
            encoded = _spread_bytes(self.model.encode(call))
            tokens += [Token(t.id, t.piece, t.start + offset, t.stop + offset) for t in encoded]
            offset += len(call)
        return tokens


def _sections(instruction: str, state: NDArray[np.floating] | None, prompt_format: PromptFormat) -> list[_Section]:
    if prompt_format == "raw-instruction-newline":
        raw = instruction.removesuffix("\n")
        return [_Section(raw, Role.INSTRUCTION), _Section("\n", Role.TEMPLATE)]
    if prompt_format == "raw-instruction":
        return [_Section(instruction, Role.INSTRUCTION)]
    cleaned = _Section(clean_instruction(instruction), Role.INSTRUCTION)
    if prompt_format == "instruction-newline":
        return [cleaned, _Section("\n", Role.TEMPLATE, encode_alone=True)]
    if state is None:
        raise ValueError(f"the prompt format {prompt_format} needs the state")
    bins = " ".join(str(number) for number in digitise_state(state))
    return [
        _Section("Task: ", Role.TEMPLATE),
        cleaned,
        _Section(", State: ", Role.TEMPLATE),
        _Section(bins, Role.STATE),
        _Section(";\nAction: ", Role.TEMPLATE),
    ]


def _spread_bytes(tokens: list[Token]) -> list[Token]:
    """Give every byte token the whole character; sentencepiece gives it to the last byte only."""
    spread: list[Token] = []
    for token in reversed(tokens):
        empty = token.start == token.stop
        following = spread[-1] if spread else None
        if empty and following is not None and following.start == token.start:
            token = Token(token.id, token.piece, following.start, following.stop)
        spread.append(token)
    return spread[::-1]


def _role(token: Token, text: str, role_of_character: list[Role]) -> Role:
    """Return the role of most visible characters of the token; for spaces only, of the first character."""
    characters = range(token.start, token.stop) or range(token.start, token.start + 1)
    visible = [i for i in characters if i < len(text) and not text[i].isspace()]
    roles = [role_of_character[i] for i in visible] or [role_of_character[min(token.start, len(text) - 1)]]
    return max(dict.fromkeys(roles), key=roles.count)


def check_vocabulary(tokenizer: PromptTokenizer, table_rows: int, model: str) -> None:
    """Raise `BadArgument` if the tokenizer cannot be the model's.

    It has more pieces than the model's table, or the model has full size and the tokenizer is not PaliGemma's: 256000
    pieces of Gemma, with or without the locations and segments, which pi does not use.
    """
    pieces = tokenizer.vocab_size
    if pieces > table_rows:
        raise BadArgument(
            f"The tokenizer has {pieces} pieces, but the model '{model}' has {table_rows}: it is another model's "
            "tokenizer."
        )
    if table_rows == PALIGEMMA_VOCABULARY and pieces < GEMMA_VOCABULARY:
        raise BadArgument(
            f"The tokenizer has {pieces} pieces, but the model '{model}' was made with PaliGemma's, which has "
            f"{PALIGEMMA_VOCABULARY}: it is another model's tokenizer."
        )
