"""`vla-analyze words`: which words of the instruction are read."""

from __future__ import annotations

import argparse

from vla_attention.analyze.arguments import (
    add_intervals,
    add_output,
    add_selection,
    add_stores,
    output_folder,
    settings_of,
    stores_of,
)
from vla_attention.analyze.show.output_files import write_parquet
from vla_attention.analyze.show.screen import fitted, write_whole
from vla_attention.schemas.command_line import command_parser

_EXAMPLES = """examples:
  vla-analyze words runs/libero_10.zarr
  vla-analyze words runs/libero_10.zarr --task 3
  vla-analyze words runs/libero_10.zarr --layers 5 6 7 --per-head
  vla-analyze words runs/cosmos.zarr

A word is measured by all its pieces. Stop words are those of a shipped list of function words (docs/groupings.md),
content words all others.
"""


def build_parser() -> argparse.ArgumentParser:
    """The parser of `vla-analyze words STORE ...`."""
    parser = command_parser(
        "vla-analyze words",
        "Which words of the instruction are read: mass, lift over uniform attention and share of the linguistic mass "
        "of every word, with intervals; content and stop words, bos, template and state beside "
        "them.",
        _EXAMPLES,
    )
    add_stores(parser)
    selection = add_selection(parser)
    add_intervals(parser)
    selection.add_argument(
        "--task", type=int, metavar="N", help="one task only: its instruction word by word, in reading order"
    )
    selection.add_argument("--per-head", action="store_true", help="keep heads apart in the table")
    add_output(parser, "results/STORE/words")
    return parser


def run(arguments: argparse.Namespace) -> int:
    """Measure the words; print them, write the table and the picture."""
    from vla_attention.analyze.words.text import words_text
    from vla_attention.analyze.words.word_study import study_words

    study = study_words(stores_of(arguments), settings_of(arguments), arguments.task)
    text = words_text(study)
    folder = output_folder(arguments, "words" if arguments.task is None else f"words_task{arguments.task:03d}")
    files = write_parquet(folder, words=study.episodes, words_summary=study.summary)
    files.append(write_whole(folder, text))
    if not arguments.no_plots:
        from vla_attention.analyze.words.plot_word_bars import plot_word_bars

        files += plot_word_bars(study.summary, folder, study.layer, study.instruction)
    print(fitted(text, folder, files))
    return 0
