"""A tokenizer for models of full size with random weights."""

from __future__ import annotations

from vla_attention.capture.policies.pi.tokenizer import PromptTokenizer


class FullSizeTokenizer(PromptTokenizer):
    """The embedded policy's tokenizer with the vocabulary size of PaliGemma's, which may not be distributed."""

    vocab_size = 257_152  # type: ignore[assignment]
