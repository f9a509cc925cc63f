"""An opened store, without the studies: what is in it, masses, ratios, labelled arrays. See `vla_attention.analyze.api`."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Collection, Sequence
from typing import TYPE_CHECKING, Literal, Unpack

import polars as pl

from vla_attention.analyze.measures.frames import Tables
from vla_attention.analyze.measures.question import AnalysisSettings, Question, ask
from vla_attention.analyze.measures.settings import Settings, analysis_settings
from vla_attention.analyze.ratios.analysis import Analysis, analyse
from vla_attention.schemas.errors import BadArgument, did_you_mean, listing
from vla_attention.schemas.stores.reader import Store
from vla_attention.schemas.stores.store_format import RootAttributes

if TYPE_CHECKING:
    import xarray

LevelName = Literal["tasks", "episodes", "replans", "steps"]
_LEVELS = ("tasks", "episodes", "replans", "steps")
#: Answers that are kept, so that asking for tasks after episodes does not read everything again.
_KEPT = 4


class Opened:
    """The part of `vla_attention.analyze.api.OpenStores` that is about masses and ratios; its examples run as tests like those there."""

    def __init__(self, stores: Sequence[Store]) -> None:
        self.stores = tuple(stores)
        self._answers: OrderedDict[AnalysisSettings, Analysis] = OrderedDict()

    @property
    def attributes(self) -> RootAttributes:
        """The run's own description; the same for all stores but for the suite."""
        return self.stores[0].attributes

    @property
    def episodes(self) -> pl.DataFrame:
        """One row per episode, from its attributes; reads no rows.

        >>> va.open(store).episodes.select("task_id", "episode_index", "success", "num_replans").rows()
        [(0, 0, False, 3), (0, 1, True, 3), (1, 0, False, 3), (1, 1, True, 3)]
        """
        names = [
            "task_id",
            "task_name",
            "instruction",
            "episode_index",
            "initial_state_index",
            "success",
            "num_steps",
            "num_replans",
        ]
        return pl.DataFrame(
            [
                {
                    "store": str(store.path),
                    "suite": store.suite,
                    **{name: getattr(episode.attributes, name) for name in names},
                }
                for store in self.stores
                for episode in store.episodes
            ],
            schema_overrides={"task_id": pl.Int64},
        )

    def ask(self, **settings: Unpack[Settings]) -> Question:
        """The checked question behind the tables, for the functions of the package's modules.

        >>> va.open(store).ask(grouping="cameras", layers=2).selection.blocks
        (2,)
        """
        return ask(self.stores, analysis_settings(**settings))

    def analysis(self, **settings: Unpack[Settings]) -> Analysis:
        """All tables and the summary of one grouping, as `vla-analyze STORE` computes them; the last few are kept."""
        wanted = analysis_settings(**settings)
        if wanted not in self._answers:
            self._answers[wanted] = analyse(ask(self.stores, wanted))
        self._answers.move_to_end(wanted)
        while len(self._answers) > _KEPT:
            self._answers.popitem(last=False)
        return self._answers[wanted]

    def ratios(self, level: LevelName = "tasks", **settings: Unpack[Settings]) -> pl.DataFrame:
        """Ratios as `vla-analyze ratios` gives them: one row per cell. Masses of the groups are in `masses`.

        `level`: "tasks" (per task and over all, with intervals), "episodes", "replans" or "steps" (every replan, layer, denoise step).
        Columns: `vla_attention.analyze.measures.aggregate` and `vla_attention.analyze.measures.steps`.

        >>> run = va.open(store)
        >>> run.ratios("steps", groups={"bowl": "word:bowl", "rest": "*"}, layers=2, denoise="last").height
        12
        >>> run.ratios("episodes", grouping="cameras", tasks=0).select("task_id", "layer").unique().height
        3
        """
        check_name("level", level, _LEVELS)
        table: Tables = getattr(self.analysis(**settings), level)
        return table.cells

    def masses(self, level: LevelName = "steps", **settings: Unpack[Settings]) -> pl.DataFrame:
        """Masses, fractions, densities and lifts of the groups: one row per cell of `ratios` and group.

        `level`: as in `ratios`. `masses.pivot("group", index=[...], values=["mass", "fraction"])` makes a column per group of it.

        >>> masses = va.open(store).masses(grouping="instruction", per_head=True)
        >>> masses.group_by("group").agg(pl.col("keys").mean()).filter(group="linguistic")["keys"].to_list()
        [5.0]
        """
        check_name("level", level, _LEVELS)
        table: Tables = getattr(self.analysis(**settings), level)
        return table.groups

    def summary(self, **settings: Unpack[Settings]) -> str:
        """The text that `vla-analyze STORE` prints.

        >>> va.open(store).summary().splitlines()[0]
        'ATTENTION SUMMARY'
        """
        return self.analysis(**settings).summary

    def describe(self) -> str:
        """What the stores hold: run, layout, words, objects, tasks; the text of `vla-analyze STORE --list`.

        >>> "akita_black_bowl_1" in va.open(store).describe()
        True
        """
        from vla_attention.analyze.stores.contents import describe_store

        return "\n\n".join(describe_store(store) for store in self.stores)

    def contributions(self, **settings: Unpack[Settings]) -> pl.DataFrame:
        """Norms of what seeing and reading add to the residual stream (`vla_attention.analyze.measures.contributions`), where they were recorded.

        >>> va.open(store).contributions(layers=0)["contribution_ratio"].is_finite().all()
        True

        Raises:
            BadArgument: the stores hold no contributions.
        """
        from vla_attention.analyze.export.tables import chosen_tables

        return chosen_tables(self.analysis(**settings), ["contributions"])["contributions"]

    def to_xarray(
        self, rows: bool = False, most_gigabytes: float = 4.0, **settings: Unpack[Settings]
    ) -> xarray.Dataset:
        """Masses of every head as labelled arrays, or with `rows` the rows themselves; see `vla_attention.analyze.export.labelled_arrays`.

        (episode, replan) is one axis `sample`. Rows that would take more memory than `most_gigabytes` are refused. Needs the extra
        `xarray`.

        >>> va.open(store).to_xarray(grouping="cameras")["mass"].dims
        ('sample', 'layer', 'denoise', 'head', 'group')
        >>> va.open(store).to_xarray(rows=True, layers=2)["rows"].shape
        (12, 1, 2, 2, 39)

        Raises:
            MissingDependency: xarray is not installed.
            BadArgument: the rows are larger than allowed.
        """
        from vla_attention.analyze.export.labelled_arrays import masses_array, rows_array

        question = self.ask(**settings)
        return rows_array(question, int(most_gigabytes * 1e9)) if rows else masses_array(question)

    def __str__(self) -> str:
        episodes = [episode.attributes for store in self.stores for episode in store.episodes]
        tasks = {(store.suite, task) for store in self.stores for task in store.task_ids}
        suites = list(dict.fromkeys(store.suite for store in self.stores))
        return (
            f"OpenStores of {_count(len(self.stores), 'store')}: {_count(len(episodes), 'episode')} of {_count(len(tasks), 'task')} "
            f"({sum(episode.success for episode in episodes)} solved), {sum(episode.num_replans for episode in episodes)} replans, "
            f"suite {listing(suites)}"
        )


def check_name(what: str, given: str, known: Collection[str]) -> None:
    """Raise `BadArgument` unless a name is one of those that exist."""
    if given not in known:
        raise BadArgument(f"Unknown {what} '{given}'.{did_you_mean(given, known)} Existing: {listing(known)}.")


def _count(count: int, noun: str) -> str:
    return f"{count} {noun}{'' if count == 1 else 's'}"
