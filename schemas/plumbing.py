"""Whether an instruction gets through to the model: what one extra call at the beginning of an episode showed."""

from __future__ import annotations

from vla_attention.schemas.errors import listing
from vla_attention.schemas.jsonable import Document, Number
from vla_attention.schemas.safe_text import visible


class Plumbing(Document, frozen=True):
    """What was seen at the first policy call of an episode, which was made again with a wholly different instruction.

    Only the first two are plumbing: a tokenizer, the key of a data set, a batch. A model may get every word and pay no
    attention to it.

    Attributes:
        instruction, other: what the call was given, and what it was given instead; no `other`: no call was made.
        unread: the words of the instruction that are in none of the prompt's tokens.
        row_of_another: whether a row of a batch was answered as if it had the first row's instruction; None: not looked
            at (no batch with two instructions, or both give the same actions).
        input_changed: whether the model's text input was another one; None where it was not seen.
        rows_changed: the largest change of a recorded attention probability; None where it was not seen.
        action_changed: root mean square over the chunk of the change of the action, in the unit of each dimension of
            the action that effects have; None where no call was made.
        why_not: why no call was made.
    """

    instruction: str
    other: str = ""
    unread: tuple[str, ...] = ()
    row_of_another: bool | None = None
    input_changed: bool | None = None
    rows_changed: Number | None = None
    action_changed: Number | None = None
    why_not: str = ""

    @property
    def problem(self) -> str:
        """What is wrong before the model, as a sentence; empty where nothing is."""
        told = f"'{visible(self.instruction)}'"
        if self.unread:
            return f"The model never reads {listing([visible(word) for word in self.unread])} of {told}."
        if self.row_of_another:
            return "In a batch, another row was answered as if it had the first row's instruction."
        if self.input_changed is False:
            return f"Whatever it is told, the model's input is the same: told '{visible(self.other)}', as told {told}."
        return ""
