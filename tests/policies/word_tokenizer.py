"""A tokenizer of whole words, for policies of test size."""

from __future__ import annotations

from collections.abc import Sequence

INSTRUCTION = "put the bowl on the plate"
WORDS = ("put", "the", "bowl", "on", "plate", "task", "robot", "now", "slowly")
_FIRST = 10


class WordTokenizer:
    """Words from id 10 on; 0 is padding, 1 and 2 are special too."""

    all_special_ids = (0, 1, 2)
    bos_token_id = 2

    def encode(self, text: str) -> list[int]:
        """Return the ids of words."""
        return [_FIRST + WORDS.index(word) for word in text.split()]

    def decode(self, ids: Sequence[int]) -> str:
        """Return words with spaces between them; ids that are no word are shown as numbers."""
        named = [
            WORDS[number - _FIRST] if 0 <= number - _FIRST < len(WORDS) else f"<{number}>" for number in map(int, ids)
        ]
        return " ".join(named)
