"""Add sentences to a file of T5 embeddings, on a machine that has T5's encoder (for the published policies, t5-11b):

python -m vla_attention.capture.policies.cosmos.encode_prompts libero_t5_embeddings.pkl NEW.pkl --t5-encoder FOLDER \\
    --prompt "put the bowl on the plate" "put the plate on the bowl"
"""

from __future__ import annotations

import argparse
import pickle
import sys
from collections.abc import Sequence
from pathlib import Path

from vla_attention.capture.policies.cosmos.locate import T5_TOKENIZER
from vla_attention.capture.policies.cosmos.t5_pickle import read_embeddings
from vla_attention.capture.policies.cosmos.text import PieceTokenizer, T5Encoder
from vla_attention.schemas.command_line import run_command
from vla_attention.schemas.errors import plural


def _run(given: argparse.Namespace) -> int:
    table, encoder = read_embeddings(given.table), T5Encoder(given.t5_encoder)
    tokenizer = PieceTokenizer(encoder.folder / T5_TOKENIZER)
    wanted = [prompt for prompt in dict.fromkeys(given.prompt) if prompt not in table.by_instruction]
    added = {prompt: encoder.encode(tokenizer.token_ids(prompt), *table.shape) for prompt in wanted}
    with given.output.open("xb") as file:
        pickle.dump({**table.by_instruction, **added}, file)
    print(f"{plural(len(added), 'sentence')} added: {given.output}")
    return 0


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command; returns its exit code."""
    parser = argparse.ArgumentParser(description="Add sentences to a file of T5 embeddings.")
    parser.add_argument("table", type=Path, help="file of embeddings")
    parser.add_argument("output", type=Path, help="the new file")
    parser.add_argument("--t5-encoder", required=True, metavar="FOLDER", help=f"T5 with its {T5_TOKENIZER}")
    parser.add_argument("--prompt", nargs="+", required=True, metavar="TEXT", help="sentences")
    given = parser.parse_args(argv)
    return run_command("encode_prompts", lambda: _run(given), "No file was written.")


if __name__ == "__main__":
    sys.exit(main())
