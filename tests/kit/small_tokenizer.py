"""A tokenizer that fits the golden checkpoints' 300 tokens, trained on the spot in the manner of PaliGemma's."""

from __future__ import annotations

import io
from pathlib import Path

import sentencepiece

INSTRUCTIONS = (
    "lift the red cube",
    "stack the red cube on top of the green cube",
    "pick up the milk carton and place it in the bin",
    "fit the square nut onto the square peg",
    "put the black bowl on the plate",
    "open the door",
)


def train_small_tokenizer(path: Path, vocabulary: int = 300) -> Path:
    """Train a sentencepiece model of at most `vocabulary` pieces, without bytes for unknown characters."""
    states = [f"Task: {text}, State: 128 0 255 -1 64 37;\nAction: " for text in INSTRUCTIONS]
    model = io.BytesIO()
    sentencepiece.SentencePieceTrainer.train(
        sentence_iterator=iter([*INSTRUCTIONS, *states]),
        model_writer=model,
        model_type="bpe",
        vocab_size=vocabulary,
        hard_vocab_limit=False,
        pad_id=0,
        eos_id=1,
        bos_id=2,
        unk_id=3,
        split_digits=True,
        user_defined_symbols=["\n"],
        normalization_rule_name="identity",
        add_dummy_prefix=False,
        remove_extra_whitespaces=False,
        num_threads=1,
        minloglevel=2,
    )
    path.write_bytes(model.getvalue())
    return path
