"""`vla-capture rerun --series`: all conditions in one process, each into a store of its own."""

from __future__ import annotations

import argparse
import copy
from dataclasses import dataclass, replace
from pathlib import Path

from vla_attention.capture.command_line import check_writable
from vla_attention.capture.interventions.arguments import read_interventions
from vla_attention.capture.interventions.attention_edits import QueryWithoutKeys
from vla_attention.capture.interventions.resolution import TooFewKeys, check_places, interventions_for
from vla_attention.capture.rerun.base_store import check_may_change
from vla_attention.capture.rerun.rerun_store import Rerun
from vla_attention.capture.rerun.series import Series, SeriesCondition, plan_series
from vla_attention.capture.rollout.progress import say
from vla_attention.schemas.errors import BadArgument, listing
from vla_attention.schemas.interventions import Interventions, KeyKnockout
from vla_attention.schemas.safe_text import file_part
from vla_attention.schemas.stores.reader import Store
from vla_attention.schemas.stores.store_format import STORE_SUFFIX
from vla_attention.schemas.stores.store_url import local_path


@dataclass(frozen=True)
class SeriesRun:
    """A planned series and the folder of its stores."""

    base: Store
    series: Series
    folder: Path

    @classmethod
    def planned(cls, arguments: argparse.Namespace, base: Store) -> SeriesRun:
        """Plan the series of the arguments. Needs no policy; errors come before the minutes for loading one."""
        _refuse_own_interventions(arguments)
        template = _template(arguments)
        # A word acts through the pictures that have read it: cut for the action queries alone, it seems to do nothing.
        words = template if arguments.knockout_queries is not None else replace(template, queries="all")
        check_places(Interventions(keys=(template,)), base.attributes.policy)
        series = plan_series(
            base,
            arguments.series,
            template,
            base.attributes.protocol.seed + 1 if arguments.noise_seed is None else arguments.noise_seed,
            words=words if arguments.words else None,
            objects=arguments.objects,
        )
        check_may_change(base, series.conditions[0].interventions)
        folder = arguments.output_dir or local_path(base.path).with_name(f"{base.path.stem}_reruns")
        check_writable(folder, "--output-dir")
        return cls(base, series, folder)

    def write(self, rerun: Rerun, seconds_of_call: float | None) -> None:
        """Make all reruns that are not whole yet. seconds_of_call: for an estimate of the time; None: no estimate."""
        for note in self.series.notes:
            say(note)
        calls_of = {episode.name: episode.attributes.num_replans for episode in self.base.episodes}
        conditions = self.series.conditions
        changes = [interventions_for(condition.interventions, rerun.policy) for condition in conditions]
        calls = [calls_of[name] for condition in conditions for name in condition.episodes]
        time = "" if seconds_of_call is None else f", about {_duration(sum(calls) * seconds_of_call)} if none is there"
        say(f"Series: {len(conditions)} conditions, {sum(calls)} policy calls{time}. Folder: {self.folder}")
        say(rerun.describe_disk(self.folder, calls))
        impossible = []
        for number, (condition, changed) in enumerate(zip(conditions, changes, strict=True), start=1):
            say(f"[{number}/{len(conditions)}] {condition.name}: {changed.describe()}")
            try:
                self._write(rerun, condition, changed)
            except (QueryWithoutKeys, TooFewKeys) as error:
                say(f"{condition.name} is left out: {error}")
                impossible.append(condition.name)
        if impossible:
            say(f"Not possible: {listing(impossible, 40)}; the reasons are above.")
        say(f"Next: vla-analyze effects {self.base.path} {self.folder}")

    def _write(self, rerun: Rerun, condition: SeriesCondition, changed: Interventions) -> None:
        target = self.folder / f"{file_part(condition.name)}{STORE_SUFFIX}"
        rerun.write(target, "resume", changed, lambda episode: episode.name in condition.episodes)


def _refuse_own_interventions(arguments: argparse.Namespace) -> None:
    for option, given in (
        ("--knockout", arguments.knockout),
        ("--keep", arguments.keep),
        ("--attention", arguments.attention),
        ("--prompt", arguments.prompt),
        ("--image", arguments.image),
        ("--allow-empty", arguments.allow_empty),
        ("--name", arguments.name),
        ("--store", arguments.store),
        ("--overwrite", arguments.overwrite),
    ):
        if given:
            raise BadArgument(
                f"Cannot use {option} with --series, which makes its own interventions and stores; run vla-capture "
                "rerun once more for others."
            )


def _template(arguments: argparse.Namespace) -> KeyKnockout:
    """Return a knockout with the places, queries, weight and seed of the arguments."""
    words = copy.copy(arguments)
    words.knockout = ["role:image"]  # any selector: the plan replaces it
    words.noise_seed = None
    return read_interventions(words).keys[0]


def _duration(seconds: float) -> str:
    """Return seconds as text: 40 s, 12 min, 3.5 h."""
    if seconds < 90:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"
