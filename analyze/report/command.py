"""`vla-attention report`: one self-contained HTML file."""

from __future__ import annotations

import argparse

from vla_attention.analyze.arguments import add_question, add_stores, output_place, question_of
from vla_attention.analyze.report.report_settings import ReportSettings
from vla_attention.schemas.command_line import command_parser
from vla_attention.schemas.options import add_option

_EXAMPLES = """examples:
  vla-attention report runs/libero_10.zarr --open
  vla-attention report runs/libero_10.zarr --grouping instruction --layers 9 13 17 --output paper/report.html
  vla-attention report runs/a.zarr runs/b.zarr --num-episodes 8 --num-replans 10 --output results/both
  vla-attention report runs/cosmos.zarr --site self
  vla-attention report runs/cubes.zarr --reruns reruns/cubes

The file needs no network and nothing beside it: open it with a double click, mail it, print it.
"""


def build_parser() -> argparse.ArgumentParser:
    """The parser of `vla-attention report STORE ...`."""
    from pathlib import Path

    parser = command_parser(
        "vla-attention report",
        "One self-contained HTML file: what was run, the ratio with its interval and its caveats, tasks, layers, "
        "contributions, overlays of some episodes, methods.",
        _EXAMPLES,
    )
    add_stores(parser)
    add_question(parser)
    content, defaults = parser.add_argument_group("content"), ReportSettings()
    add_option(
        content,
        "--num-episodes",
        was=("--episodes",),
        dest="episodes",
        type=int,
        default=defaults.episodes,
        metavar="N",
        help="episodes with overlays (default: %(default)s; 0: none)",
    )
    add_option(
        content,
        "--num-replans",
        was=("--replans",),
        dest="replans",
        type=int,
        default=defaults.replans,
        metavar="N",
        help="replans of each, at most (default: %(default)s)",
    )
    add_option(
        content,
        "--reruns",
        was=("--effects",),
        type=Path,
        nargs="+",
        default=[],
        metavar="RERUN",
        help="reruns of the store with interventions (vla-attention capture rerun), or folders of them; without "
        "one, the effects "
        "that the store holds",
    )
    content.add_argument("--quick", action="store_true", help="leave out what reads every row: sinks, words, objects")
    output = parser.add_argument_group("output")
    output.add_argument(
        "--output",
        type=output_place,
        metavar="PATH",
        help="folder, in which report.html is written, or a file FILE.html (default: results/STORE)",
    )
    output.add_argument("--open", action="store_true", help="show the page in the browser")
    return parser


def run(arguments: argparse.Namespace) -> int:
    """Analyse and write the page."""
    from pathlib import Path

    from vla_attention.analyze.report.page import report_file, write_report
    from vla_attention.analyze.show.browser import open_page
    from vla_attention.analyze.show.numbers import plural

    settings = ReportSettings(arguments.episodes, arguments.replans, not arguments.quick, tuple(arguments.reruns))
    path = report_file(arguments.output or Path("results") / arguments.stores[0].stem)
    question = question_of(arguments)
    write_report(question, path, settings)
    for line in question.skipped:
        print(line)
    megabytes = path.stat().st_size / 1e6
    then = "" if arguments.open else " Open it in a browser."
    print(f"{path}: {megabytes:.1f} MB on {plural(len(question.selected), 'episode')}.{then}")
    if arguments.open and (refused := open_page(path)):
        print(refused)
    return 0
