"""Train the small tokenizer of the embedded policy, from the instructions of the five LIBERO suites and a few more.

Usage: python scripts/train_embedded_tokenizer.py [OUTPUT]

Needs the hf-libero package for the instruction texts only; nothing of it is imported. The result is deterministic, and
it behaves like PaliGemma's tokenizer where that matters: the same control ids, no prefix space, digits one by one,
"\\n" a piece of its own, unknown characters as bytes.
"""

from __future__ import annotations

import importlib.util
import io
import re
import sys
from pathlib import Path

import sentencepiece

OUTPUT = Path(__file__).parent.parent / "capture/policies/embedded/tokenizer.model"
VOCABULARY = 768
LANGUAGE_FIELD = re.compile(r"\(:language\s+([^)]*)\)")
OTHER_INSTRUCTIONS = (
    "lift the red cube",
    "stack the red cube on top of the green cube",
    "pick up the milk carton and place it in the bin",
    "pick up the can and place it in the bin",
    "pick up the bread and place it in the bin",
    "pick up the cereal box and place it in the bin",
    "fit the square nut onto the square peg",
    "open the door",
)


def libero_instructions() -> list[str]:
    """Return the different instructions of all LIBERO tasks, sorted, read from the task files themselves."""
    package = importlib.util.find_spec("libero")
    if package is None or package.origin is None:
        raise SystemExit("The hf-libero package is needed for its task files; install it with `make setup`.")
    # find_spec on the top level does not run libero.libero, which asks questions on the terminal when first imported.
    files = sorted((Path(package.origin).parent / "libero" / "bddl_files").glob("*/*.bddl"))
    fields = [field for file in files for field in LANGUAGE_FIELD.findall(file.read_text(encoding="utf-8"))]
    return sorted({" ".join(field.split()) for field in fields})


def corpus() -> list[str]:
    """Return the training sentences: each instruction as it stands in the two prompt formats."""
    instructions = [*libero_instructions(), *OTHER_INSTRUCTIONS]
    with_state = [f"Task: {instruction}, State: 0 1 2 3 4 5 6 7 8 9 -1;" for instruction in instructions]
    return [*instructions, *with_state, *["Action: "] * len(instructions)]


def train() -> bytes:
    """Return the trained sentencepiece model."""
    model = io.BytesIO()
    sentencepiece.SentencePieceTrainer.train(
        sentence_iterator=iter(corpus()),
        model_writer=model,
        model_type="bpe",
        vocab_size=VOCABULARY,
        hard_vocab_limit=False,
        character_coverage=1.0,
        pad_id=0,
        eos_id=1,
        bos_id=2,
        unk_id=3,
        byte_fallback=True,
        split_digits=True,
        user_defined_symbols=["\n"],
        normalization_rule_name="identity",
        add_dummy_prefix=False,
        remove_extra_whitespaces=False,
        num_threads=1,
        minloglevel=2,
    )
    return model.getvalue()


def main(arguments: list[str]) -> None:
    """Train and write the model."""
    target = Path(arguments[0]) if arguments else OUTPUT
    target.parent.mkdir(parents=True, exist_ok=True)
    target.write_bytes(train())
    processor = sentencepiece.SentencePieceProcessor(model_file=str(target))
    print(f"{target}: {processor.get_piece_size()} pieces, {target.stat().st_size} bytes")


if __name__ == "__main__":
    main(sys.argv[1:])
