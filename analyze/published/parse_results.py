"""`parse-attention-ratio-results`: summaries and pictures from results files, ours or the published scripts'."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from vla_attention.analyze.options import output_place
from vla_attention.schemas.command_line import OneSentenceParser, run_command
from vla_attention.schemas.safe_text import file_part
from vla_attention.schemas.stop_signals import end_program

if TYPE_CHECKING:
    from vla_attention.analyze.core.result import Figure
    from vla_attention.analyze.published.results_tables import ResultsTables

PROGRAM = "parse-attention-ratio-results"
_EXAMPLES = """examples:
  parse-attention-ratio-results --results results/attention_ratio/attention_ratio_results_libero_10.json
  parse-attention-ratio-results --results results/libero_10/default --plot-all --output summary.txt
  parse-attention-ratio-results --results 'results/cosmos_*/attention_ratio_results_*.json' --plot-comparison

Several files of one kind are also summarised together (COMBINED). Masses of latent frames (Cosmos scripts) are
never pooled with masses of image and text keys; --plot-comparison shows both side by side.
"""
#: Pictures of one file, by their options.
_OF_FILE = {
    "distribution": "how ratios are spread over replans and layers",
    "per_task": "mean ratio per task with its interval",
    "fractions": "visual, linguistic and other fractions per layer",
}
_AXIS = "visual / linguistic (logarithmic)"
_NO_KEYS = "The file does not hold the numbers of keys: there is no line of evenly spread attention."
_LOOK = {"log": True, "uniform": "uniform_ratio", "baseline_name": "if spread evenly"}


def build_parser() -> argparse.ArgumentParser:
    """The parser of `parse-attention-ratio-results`."""
    about = "Summaries and pictures from attention_ratio_results_SUITE.json files, ours or the published scripts'."
    parser = OneSentenceParser(prog=PROGRAM, description=about, epilog=_EXAMPLES)
    files = "results files, folders of them, or patterns for either"
    parser.add_argument("--results", nargs="+", required=True, metavar="PATH", help=files)
    parser.add_argument("--output", type=output_place, metavar="FILE", help="also write the summary into this file")
    parser.add_argument(
        "--output-dir", type=output_place, default=Path("results/attention_ratio_analysis"), metavar="FOLDER",
        help="folder of the pictures (default: %(default)s)",
    )  # fmt: skip
    several = {"comparison": "mean ratio of several files side by side"}
    for name, what in ({"all": "every picture"} | _OF_FILE | several).items():
        parser.add_argument(f"--plot-{name.replace('_', '-')}", action="store_true", help=what)
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit code (2: wrong input, which one sentence explains)."""
    return run_command(PROGRAM, lambda: run(build_parser().parse_args(argv)), "nothing was left half written.")


def run(arguments: argparse.Namespace) -> int:
    """Read the files, print and write the summary, draw the chosen pictures, each with its numbers as CSV."""
    # Imported here, so that `--help` does not wait for polars.
    from vla_attention.analyze.published.results_reader import find_results, read_results_file
    from vla_attention.analyze.published.results_tables import labels_of, results_tables
    from vla_attention.analyze.published.results_text import summary_of_files, why_not_pooled
    from vla_attention.analyze.render.figures import save
    from vla_attention.analyze.render.files import replacing, write_text, writing
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
    folder: Path = arguments.output_dir
    with writing("pictures", folder, "another --output-dir"):
        for figure in _figures(arguments, labels, tables):
            written += [*save(figure, folder, formats=("png", "pdf")), folder / f"{figure.name}.csv"]
            with replacing(written[-1]) as temporary:
                figure.frame.write_csv(temporary)
    for path in written:
        print(f"written: {path}")
    return 0


def _figures(arguments: argparse.Namespace, labels: Sequence[str], tables: Sequence[ResultsTables]) -> list[Figure]:
    """The chosen pictures, under the published names; with several files they end with the label of their file."""
    wanted = [name for name in _OF_FILE if arguments.plot_all or getattr(arguments, f"plot_{name}")]
    figures: list[Figure] = []
    for label, table in zip(labels, tables, strict=True):
        end = f"_{file_part(label.replace('/', '_'))}" if len(tables) > 1 else ""
        made = _figures_of_file(table, end) if wanted else {}
        figures += [made[name] for name in wanted]
    if arguments.plot_comparison or (arguments.plot_all and len(tables) > 1):
        figures += _comparison(tables, labels)
    return figures


def _figures_of_file(table: ResultsTables, end: str) -> dict[str, Figure]:
    """The pictures of a file by the names of their options; `end` stands behind theirs."""
    import polars as pl

    from vla_attention.analyze.core.levels import overall
    from vla_attention.analyze.core.result import Figure
    from vla_attention.analyze.measures.tables import LAYERS_AVG

    note = _NO_KEYS if table.replans["uniform_ratio"].is_null().all() else ""
    label = pl.coalesce(pl.format("{}: {}", "task_id", "instruction"), "suite", pl.lit("all")).alias("task")
    layers = table.replans["layer"].unique(maintain_order=True).to_list()
    columns = ["suite", "task_id", "episode_index", "replan", "env_step", "layer", "ratio", "uniform_ratio"]
    spread = table.replans.filter(pl.col("layer").is_in(layers if len(layers) != 2 else layers[:1])).select(columns)
    tasks, dots = (rows.filter(layer=table.layer).with_columns(label) for rows in (table.tasks, table.episodes))
    return {
        "distribution": Figure(
            f"ratio_distribution{end}", "distribution", spread, "Ratio visual / linguistic over policy calls, by layer",
            f"Boxes: quartiles, with the median; whiskers: 5% to 95%. {note}".strip(),
            {**_LOOK, "x": "layer", "value": "ratio", "ylabel": _AXIS},
        ),
        "per_task": Figure(
            f"ratio_per_task{end}", "forest", tasks, "Ratio visual / linguistic of every task",
            f"Geometric means with 95% intervals; small dots: episodes. {note}".strip(),
            {**_LOOK, "label": "task", "value": "geometric_mean", "dots": dots, "xlabel": _AXIS},
        ),
        "fractions": Figure(
            f"attention_fractions{end}", "stacked", overall(table.groups), "How attention is divided, by layer",
            f"Masses: {table.grouping.description}.",
            {"x": "layer", "value": "fraction", "color": "group", "ylabel": "part of the attention",
             "mean": LAYERS_AVG, "num_episodes": dots.height},
        ),
    }  # fmt: skip


def _comparison(tables: Sequence[ResultsTables], labels: Sequence[str]) -> list[Figure]:
    """The files side by side, each in one layer: geometric mean ratios, and the fractions of their groups."""
    import polars as pl

    from vla_attention.analyze.core.levels import overall
    from vla_attention.analyze.core.result import Figure

    columns = ["num_tasks", "num_episodes", "episodes_without_ratio", "num_replans", "num_nonfinite", "success_rate"]
    columns += ["geometric_mean", "geometric_mean_low", "geometric_mean_high", "ratio_std", "uniform_ratio"]
    ratios, fractions, dots = [], [], []
    for table, label in zip(tables, labels, strict=True):
        file = pl.lit(label).alias("file")
        tasks, groups = (overall(rows).filter(layer=table.layer) for rows in (table.tasks, table.groups))
        ratios.append(tasks.select(file, pl.lit(table.grouping.description).alias("kind"), "layer", *columns))
        fractions.append(groups.select(file, "group", "fraction", "fraction_low", "fraction_high"))
        dots.append(table.episodes.filter(layer=table.layer).select("geometric_mean", file))
    data = pl.concat(ratios, how="vertical_relaxed")
    kinds = data["kind"].n_unique() > 1
    note = " Files of different kinds measure different things: compare within a kind." if kinds else ""
    options = {**_LOOK, "label": "file", "value": "geometric_mean", "dots": pl.concat(dots), "xlabel": _AXIS}
    return [
        Figure(
            "results_comparison", "forest", data, "Ratio visual / linguistic of each results file",
            f"Geometric means over tasks, with 95% intervals.{note}", options | ({"color": "kind"} if kinds else {}),
        ),
        Figure(
            "results_comparison_groups", "stacked", pl.concat(fractions), "How attention is divided, by file", "",
            {"x": "file", "value": "fraction", "color": "group", "ylabel": "part of the attention"},
        ),
    ]  # fmt: skip


if __name__ == "__main__":
    end_program(main())
