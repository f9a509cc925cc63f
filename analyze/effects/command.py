"""`vla-attention effects`: how much actions change under interventions, beside the attention of the same replans."""

from __future__ import annotations

import argparse
from pathlib import Path

from vla_attention.analyze.arguments import add_grouping, add_intervals, add_output, add_selection, settings_of, show
from vla_attention.schemas.command_line import command_parser
from vla_attention.schemas.stores.store_url import store_place

_EXAMPLES = """examples:
  vla-attention effects runs/cubes.zarr
  vla-attention effects runs/cubes.zarr reruns/cubes
  vla-attention effects runs/cubes.zarr reruns/without_visual.zarr reruns/noise.zarr --layers 0 1 2
  vla-attention effects runs/cubes.zarr rollouts/without_language.zarr --intervals these-tasks

An effect is the root mean square over the executed steps of the change of the action, each dimension
in units of its standard deviation in BASE. Give a rerun with another noise seed (--noise-seed) and one
with random keys (--random-keys): without them nobody knows how much of an effect is chance.
"""


def build_parser() -> argparse.ArgumentParser:
    """The parser of `vla-attention effects BASE RERUN ...`."""
    parser = command_parser(
        "vla-attention effects",
        "How much the actions of a run change without what it sees, reads, or any group of keys, beside\n"
        "its attention to that group in the same replans, another noise seed and random keys.",
        _EXAMPLES,
    )
    parser.add_argument("base", type=store_place, metavar="BASE", help="the store whose policy calls were run again")
    parser.add_argument(
        "reruns",
        nargs="*",
        type=store_place,
        metavar="RERUN",
        help="stores of vla-attention capture rerun BASE, rollouts with interventions, or folders of them; without "
        "one, the effects that BASE holds (vla-capture --effects)",
    )
    add_grouping(parser)
    selection = add_selection(parser)
    selection.add_argument(
        "--dimensions",
        type=int,
        nargs="+",
        metavar="N",
        help="dimensions of the action that are compared (default: all that have a spread)",
    )
    add_intervals(parser)
    add_output(parser, "results/BASE/effects")
    return parser


def run(arguments: argparse.Namespace) -> int:
    """Print the effects; write tables and pictures."""
    from vla_attention.analyze.effects.effect_study import study_effects
    from vla_attention.analyze.effects.text import effects_sections
    from vla_attention.analyze.show.answer import Answer

    study = study_effects(arguments.base, arguments.reruns, settings_of(arguments), arguments.dimensions)

    def draw(folder: Path) -> list[Path]:
        from vla_attention.analyze.effects.plot_attention_and_effect import plot_attention_and_effect
        from vla_attention.analyze.effects.plot_effects import plot_effects

        return [*plot_effects(study, folder), *plot_attention_and_effect(study, folder)]

    tables = {"effects": study.episodes, "effects_summary": study.summary} if study.conditions else {}
    if study.given.rollouts:
        tables |= {"rollouts": study.rollout_episodes, "rollouts_summary": study.rollouts}
    answer = Answer(effects_sections(study), tables, draw if study.conditions else None, csv=True)
    return show(answer, arguments.output or Path("results") / arguments.base.stem / "effects", arguments)
