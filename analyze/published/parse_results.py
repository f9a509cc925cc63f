"""`parse-attention-ratio-results`: summaries and pictures from results files, ours or the published scripts'."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from vla_attention.analyze.options import output_place
from vla_attention.schemas.command_line import command_parser, run_command
from vla_attention.schemas.safe_text import file_part
from vla_attention.schemas.stop_signals import end_program

if TYPE_CHECKING:
    from vla_attention.analyze.published.results_reader import ResultsFile
    from vla_attention.analyze.published.results_tables import ResultsTables

PROGRAM = "parse-attention-ratio-results"
_EXAMPLES = """examples:
  parse-attention-ratio-results --results results/attention_ratio/attention_ratio_results_libero_10.json
  parse-attention-ratio-results --results results/libero_10/default --plot-all --output summary.txt
  parse-attention-ratio-results --results 'results/cosmos_*/attention_ratio_results_*.json' --plot-comparison

Several files of one kind are also summarised together (COMBINED). Masses of latent frames (Cosmos scripts) are
never pooled with masses of image and text keys; --plot-comparison shows both side by side.
"""


def build_parser() -> argparse.ArgumentParser:
    """The parser of `parse-attention-ratio-results`."""
    parser = command_parser(
        PROGRAM,
        "Summaries and pictures from attention_ratio_results_SUITE.json files, ours or the published scripts'.",
        _EXAMPLES,
    )
    parser.add_argument(
        "--results",
        nargs="+",
        required=True,
        metavar="PATH",
        help="results files, folders of them, or patterns for either",
    )
    parser.add_argument("--output", type=output_place, metavar="FILE", help="also write the summary into this file")
    parser.add_argument(
        "--output-dir",
        type=output_place,
        default=Path("results/attention_ratio_analysis"),
        metavar="FOLDER",
        help="folder of the pictures (default: %(default)s)",
    )
    parser.add_argument("--plot-all", action="store_true", help="every picture")
    parser.add_argument(
        "--plot-distribution", action="store_true", help="how ratios are spread over replans and layers"
    )
    parser.add_argument("--plot-per-task", action="store_true", help="mean ratio per task with its interval")
    parser.add_argument(
        "--plot-fractions", action="store_true", help="visual, linguistic and other fractions per layer"
    )
    parser.add_argument("--plot-comparison", action="store_true", help="mean ratio of several files side by side")
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit code (2: wrong input, which one sentence explains)."""
    return run_command(PROGRAM, lambda: run(build_parser().parse_args(argv)), "nothing was left half written.")


def run(arguments: argparse.Namespace) -> int:
    """Read the files, print and write the summary, draw the chosen pictures."""
    # Imported here, so that `--help` does not wait for polars.
    from vla_attention.analyze.published.results_reader import find_results, read_results_file
    from vla_attention.analyze.published.results_tables import labels_of, results_tables
    from vla_attention.analyze.published.results_text import summary_of_files, why_not_pooled
    from vla_attention.analyze.render.files import write_text, writing
    from vla_attention.schemas.errors import BadArgument
    from vla_attention.schemas.progress_bar import progress_bar

    paths = find_results(arguments.results)
    if arguments.plot_comparison and len(paths) < 2:
        raise BadArgument(
            f"--plot-comparison compares several results files, and --results leads to one ({paths[0]}); name more, or "
            "leave --plot-comparison out."
        )
    files = []
    with progress_bar(len(paths), "files") as advance:
        for path in paths:
            files.append(read_results_file(path))
            advance(1)
    labels = labels_of(files)
    not_pooled = why_not_pooled(files, arguments.plot_comparison)
    tables = [results_tables([file], [label]) for file, label in zip(files, labels, strict=True)]
    blocks = [summary_of_files(label, [file], table) for label, file, table in zip(labels, files, tables, strict=True)]
    if len(files) > 1:
        blocks.append(not_pooled or summary_of_files("COMBINED", files, results_tables(files, labels)))
    text = "\n".join(blocks)
    print(text)
    written: list[Path] = []
    if arguments.output is not None:
        with writing("the summary", arguments.output):
            write_text(arguments.output, text)
        written.append(arguments.output)
    written += _draw(arguments, files, labels, tables)
    for path in written:
        print(f"written: {path}")
    return 0


def _draw(
    arguments: argparse.Namespace, files: Sequence[ResultsFile], labels: Sequence[str], tables: Sequence[ResultsTables]
) -> list[Path]:
    """Draw the chosen pictures, each with its numbers as CSV.

    With several files, the picture's name ends with the label of its file.
    """
    from vla_attention.analyze.published.results_pictures import comparison, figures_of_file
    from vla_attention.analyze.render.figures import save
    from vla_attention.analyze.render.files import replacing, writing

    wanted = [
        name
        for name in ("distribution", "per_task", "fractions")
        if arguments.plot_all or getattr(arguments, f"plot_{name}")
    ]
    figures = []
    for label, table in zip(labels, tables, strict=True):
        end = f"_{file_part(label.replace('/', '_'))}" if len(files) > 1 else ""
        figures += figures_of_file(wanted, table, end)
    if arguments.plot_comparison or (arguments.plot_all and len(files) > 1):
        figures += comparison(tables, labels)
    folder: Path = arguments.output_dir
    written: list[Path] = []
    with writing("pictures", folder, "another --output-dir"):
        for figure in figures:
            written += save(figure, folder, formats=("png", "pdf"))
            written.append(folder / f"{figure.name}.csv")
            with replacing(written[-1]) as temporary:
                figure.frame.write_csv(temporary)
    return written


if __name__ == "__main__":
    end_program(main())
