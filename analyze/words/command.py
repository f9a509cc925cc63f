"""`vla-analyze words`: which words of the instruction are read."""

from __future__ import annotations

import argparse

from vla_attention.analyze.arguments import (
    add_output,
    add_selection,
    add_stores,
    output_folder,
    settings_of,
)
from vla_attention.analyze.show.output_files import report_files
from vla_attention.schemas.command_line import OneSentenceParser

_EXAMPLES = """examples:
  vla-analyze words runs/libero_10.zarr
  vla-analyze words runs/libero_10.zarr --task 3
  vla-analyze words runs/libero_10.zarr --layers 5 6 7 --per-head
  vla-analyze words runs/cosmos.zarr

A word is measured by all its pieces. Content and stop words are told apart by a shipped list of function words (docs/groupings.md).
"""


def build_parser() -> argparse.ArgumentParser:
    """The parser of `vla-analyze words STORE ...`."""
    parser = OneSentenceParser(
        prog="vla-analyze words",
        description="Which words of the instruction are read: mass, lift over uniform attention and share of the linguistic mass of "
        "every word, with intervals over tasks and episodes; content and stop words, bos, template and state beside them.",
        epilog=_EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add_stores(parser)
    selection = add_selection(parser)
    selection.add_argument(
        "--task", type=int, metavar="N", help="one task only: its instruction word by word, in reading order"
    )
    selection.add_argument("--per-head", action="store_true", help="keep heads apart in the table")
    add_output(parser, "results/STORE/words")
    return parser


def run(arguments: argparse.Namespace) -> int:
    """Measure the words; print them, write the table and the picture."""
    from vla_attention.analyze.measures.aggregate import overall_layer
    from vla_attention.analyze.measures.question import ask
    from vla_attention.analyze.show.output_files import write_parquet
    from vla_attention.analyze.words.text import words_text
    from vla_attention.analyze.words.word_reading import site_of_words, strongest_readers, words_summary, words_table
    from vla_attention.schemas.errors import BadArgument
    from vla_attention.schemas.stores.reader import open_store

    stores = [open_store(path) for path in arguments.stores]
    if arguments.task is not None and arguments.tasks:
        raise BadArgument("Give --task or --tasks, not both: --task shows one instruction word by word.")
    arguments.site = site_of_words(stores[0].attributes, arguments.site)
    if arguments.task is not None:
        arguments.tasks = [arguments.task]
    question = ask(stores, settings_of(arguments))
    instructions = list(dict.fromkeys(item.episode.attributes.instruction for item in question.selected))
    one = instructions[0] if arguments.task is not None and len(instructions) == 1 else None
    table = words_table(question)
    summary = words_summary(table, by_place=one is not None, seed=arguments.seed)
    layer = overall_layer(table)
    print(words_text(question, summary, strongest_readers(table), layer, one))
    folder = output_folder(arguments, "words" if arguments.task is None else f"words/task{arguments.task:03d}")
    files = write_parquet(folder, words=table, words_summary=summary)
    if not arguments.no_plots:
        from vla_attention.analyze.words.plot_word_bars import plot_word_bars

        files += plot_word_bars(summary, folder, layer, one)
    report_files(folder, files)
    return 0
