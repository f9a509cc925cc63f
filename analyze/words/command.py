"""`vla-attention words`: which words of the instruction are read."""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

from vla_attention.analyze.arguments import (
    add_intervals,
    add_output,
    add_selection,
    add_stores,
    only_task,
    output_folder,
    settings_of,
    show,
    stores_of,
)
from vla_attention.schemas.command_line import command_parser

_EXAMPLES = """examples:
  vla-attention words runs/libero_10.zarr
  vla-attention words runs/libero_10.zarr --task 3
  vla-attention words runs/libero_10.zarr --layers 5 6 7 --per-head
  vla-attention words runs/cosmos.zarr

A word is measured by all its pieces. Stop words are those of a shipped list of function words (docs/groupings.md),
content words all others.
"""


def build_parser() -> argparse.ArgumentParser:
    """The parser of `vla-attention words STORE ...`."""
    parser = command_parser(
        "vla-attention words",
        "Which words of the instruction are read: mass, lift over uniform attention and share of the linguistic mass "
        "of every word, with intervals; content and stop words, bos, template and state beside "
        "them.",
        _EXAMPLES,
    )
    add_stores(parser)
    selection = add_selection(parser)
    add_intervals(parser)
    selection.add_argument("--per-head", action="store_true", help="keep heads apart in the table")
    add_output(parser, "results/STORE/words")
    return parser


def run(arguments: argparse.Namespace) -> int:
    """Measure the words; print them, write the table and the picture."""
    from vla_attention.analyze.effects.text import of_task, recorded_sections
    from vla_attention.analyze.show.answer import Answer
    from vla_attention.analyze.words.text import words_sections
    from vla_attention.analyze.words.word_study import study_words

    stores, settings = stores_of(arguments), settings_of(arguments)
    # Of a single task, the instruction is shown word by word, in reading order.
    task = only_task(arguments, stores)
    settings = settings if task is None else replace(settings, tasks=None)
    study = study_words(stores, settings, task)
    sections = [*words_sections(study), *recorded_sections(stores, of_task(settings, task), "word")]

    def draw(folder: Path) -> list[Path]:
        from vla_attention.analyze.words.plot_word_bars import plot_word_bars

        return plot_word_bars(study.summary, folder, study.layer, study.instruction)

    folder = output_folder(arguments, "words" if task is None else f"words_task{task:03d}")
    return show(Answer(sections, study.files(), draw), folder, arguments)
