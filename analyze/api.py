"""The Python API: an opened store whose methods mirror the commands of `vla-analyze` and return polars frames.

The examples run as tests, with `store` and `other` being paths of small stores and `folder` that of an empty folder.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Literal, Unpack

import polars as pl

from vla_attention.analyze.measures.settings import Settings, analysis_settings
from vla_attention.analyze.opened import Opened, check_name
from vla_attention.analyze.stores.selection import check_combinable
from vla_attention.schemas.errors import BadArgument, listing
from vla_attention.schemas.stores.reader import open_store


def open_stores(stores: str | Path | Sequence[str | Path]) -> OpenStores:
    """See `va.open`."""
    paths = [stores] if isinstance(stores, (str, Path)) else list(stores)
    if not paths:
        raise BadArgument("No store was given; expected the path of a NAME.zarr, or several.")
    opened = tuple(open_store(Path(path)) for path in paths)
    check_combinable(opened)
    return OpenStores(opened)


class OpenStores(Opened):
    """One or several stores, opened for questions. Made by `va.open`; holds the episodes that were complete then.

    Every method takes the keywords of `vla_attention.analyze.measures.settings.Settings`, reads what it needs and no more, and returns a polars frame
    (which of several is chosen by `table`). Mistakes raise a `vla_attention.schemas.errors.UserError` that says what exists.

    Attributes:
        stores: the stores, as `vla_attention.schemas.stores.reader` opens them.
        attributes: the run's own description (policy, protocol, recording, sites) of the first store.

    >>> run = va.open(store)
    >>> run.attributes.recording.layers
    (0, 2)
    >>> print(run)
    OpenStores of 1 store: 4 episodes of 2 tasks (2 solved), 12 replans, suite made_up
    """

    def groups(
        self, table: Literal["groups", "words", "overlaps"] = "groups", **settings: Unpack[Settings]
    ) -> pl.DataFrame:
        """What a grouping takes, before any number: keys by span and role, words with their pieces, shared keys.

        >>> found = va.open(store).groups(groups={"bowl": "word:bowl", "rest": "*"})
        >>> found.filter(pl.col("span").is_null(), group="bowl")["keys_max"].to_list()
        [1.0]
        """
        from vla_attention.analyze.groups.group_preview import preview_groups

        check_name("table", table, ("groups", "words", "overlaps"))
        return _frame(preview_groups(self.ask(**settings)), table)

    def heads(
        self,
        table: Literal["heads", "heads_groups", "dispersion", "depth", "denoise", "denoise_groups"] = "heads",
        **settings: Unpack[Settings],
    ) -> pl.DataFrame:
        """Who looks and who reads: every head, how much heads differ, the profile over depth, over denoise steps.

        "heads" and "denoise" hold ratios, "heads_groups" and "denoise_groups" the groups' fractions and lifts.

        >>> va.open(store).heads()["head"].unique().sort().to_list()
        [0, 1]
        """
        from vla_attention.analyze.heads.head_study import study_heads

        tables = study_heads(self.ask(**settings)).tables()
        check_name("table", table, tables)
        return tables[table]

    def row_metrics(self, table: Literal["rows", "groups"] = "rows", **settings: Unpack[Settings]) -> pl.DataFrame:
        """Entropy, effective number of keys and top-k mass of every row (`heads.row_metrics.row_tables`). Reads all rows.

        "groups": entropy and effective keys inside each group; its column `row` is that of "rows".

        >>> va.open(store).row_metrics(layers=0, denoise="first", heads=1).height
        12
        """
        from vla_attention.analyze.heads.row_metrics import row_metrics

        check_name("table", table, ("rows", "groups"))
        level = row_metrics(self.ask(**settings))
        return level.cells if table == "rows" else level.groups

    def sinks(self, **settings: Unpack[Settings]) -> pl.DataFrame:
        """Keys that take far more than their share in most rows (`vla_attention.analyze.measures.sinks`), per task. Reads all rows.

        >>> va.open(store).sinks().columns[:3]
        ['suite', 'task_id', 'num_episodes']
        """
        from vla_attention.analyze.measures.sinks import sinks_table

        return sinks_table(self.ask(**settings))

    def words(self, table: Literal["summary", "episodes"] = "summary", **settings: Unpack[Settings]) -> pl.DataFrame:
        """Which words are read: over all episodes with intervals ("summary"), or per episode and layer.

        >>> words = va.open(store).words(tasks=0)
        >>> sorted(words.filter(kind="word")["item"].to_list())
        ['bowl', 'on', 'plate', 'put', 'the']
        """
        from vla_attention.analyze.words.word_study import study_words

        check_name("table", table, ("summary", "episodes"))
        return _frame(study_words(self.stores, analysis_settings(**settings)), table)

    def objects(
        self, table: Literal["objects", "times", "pointing", "iou"] = "objects", **settings: Unpack[Settings]
    ) -> pl.DataFrame:
        """Which objects are looked at: shares and lifts, shares over time, or pointing game and IoU with their masks.

        >>> objects = va.open(store).objects()
        >>> "akita_black_bowl_1" in objects["item"].to_list()
        True

        Raises:
            BadArgument: the stores hold no object masks.
        """
        from vla_attention.analyze.objects.object_settings import ObjectSettings
        from vla_attention.analyze.objects.object_study import study_objects

        check_name("table", table, ("objects", "times", "pointing", "iou"))
        options = ObjectSettings(spatial=table in ("pointing", "iou"))
        return _frame(study_objects(self.stores, analysis_settings(**settings), options).tables, table)

    def time(
        self,
        table: Literal["course", "closing", "change", "outcomes", "autocorrelation"] = "course",
        bins: int | None = None,
        window: int | None = None,
        **settings: Unpack[Settings],
    ) -> pl.DataFrame:
        """Over the course of an episode: phase-aligned means, the gripper's closing, success against failure.

        `bins` and `window` are those of `vla_attention.analyze.time.time_courses.TimeSettings`.

        >>> course = va.open(store).time(bins=3)
        >>> course["quantity"].unique().sort().to_list()[-1]
        'visual'
        """
        from vla_attention.analyze.time.time_courses import TimeSettings, time_courses

        check_name("table", table, ("course", "closing", "change", "outcomes", "autocorrelation"))
        given = {name: value for name, value in (("num_bins", bins), ("window", window)) if value is not None}
        return _frame(time_courses(self.ask(**settings), TimeSettings(**given)), table)

    def compare(
        self,
        other: OpenStores | str | Path | Sequence[str | Path],
        table: Literal["differences", "estimates", "pairs", "unpaired"] = "differences",
        allow_mismatch: Sequence[str] = (),
        names: tuple[str, str] = ("first", "other"),
        **settings: Unpack[Settings],
    ) -> pl.DataFrame:
        """This run against another: other minus this one, paired where initial states and seeds are shared.

        >>> differences = va.open(store).compare(other)
        >>> differences.filter(scope="all", layer="layers_avg", quantity="success")["difference"].to_list()
        [0.0]

        Raises:
            MixedPolicies, RunsDiffer: the runs differ in what is not compared, see `allow_mismatch` and `vla_attention.analyze.compare.runs`.
        """
        from vla_attention.analyze.compare.comparison import compare
        from vla_attention.analyze.compare.runs import RunArgument, open_runs

        check_name("table", table, ("differences", "estimates", "pairs", "unpaired"))
        opened = other if isinstance(other, OpenStores) else open_stores(other)
        arguments = [
            RunArgument(name, tuple(store.path for store in stores))
            for name, stores in zip(names, (self.stores, opened.stores), strict=True)
        ]
        runs = open_runs(arguments, analysis_settings(**settings), allow_mismatch)
        return _frame(compare(runs, allow_mismatch), table)

    def overlay(
        self,
        task: int | None = None,
        episode: int | None = None,
        replans: int | Sequence[int] | None = None,
        cameras: str | Sequence[str] | None = None,
        folder: str | Path | None = None,
        measure: Literal["lift", "share"] = "lift",
        smooth: bool = False,
        **settings: Unpack[Settings],
    ) -> pl.DataFrame:
        """Attention on the pictures of one episode: one row per (replan, camera, patch); with `folder`, also drawn there as a strip.

        The first episode unless `task` and `episode` say which; every replan unless `replans` names some. `groups` are outlined, as in
        `vla-analyze overlay`, which can also make videos.

        >>> patches = va.open(store).overlay(task=1, replans=0, folder=folder)
        >>> patches.height, sorted(file.suffix for file in folder.iterdir())
        (16, ['.csv', '.pdf', '.png'])
        """
        from vla_attention.analyze.overlay.overlay_study import study_overlay

        check_name("measure", measure, ("lift", "share"))
        study = study_overlay(
            self.stores,
            analysis_settings(**settings),
            task=task,
            episode=episode,
            cameras=[cameras] if isinstance(cameras, str) else cameras,
            replans=[replans] if isinstance(replans, int) else replans,
        )
        if folder is not None:
            from vla_attention.analyze.overlay.plot_strip import plot_overlay_strip

            plot_overlay_strip(study, Path(folder), measure=measure, smooth=smooth)
        return study.table

    def report(
        self, path: str | Path, episodes: int | None = None, replans: int | None = None, **settings: Unpack[Settings]
    ) -> Path:
        """Write the self-contained HTML page of `vla-analyze report`; returns its path.

        `episodes` with overlays and `replans` of each are those of `vla_attention.analyze.report.settings.ReportSettings`.

        >>> page = va.open(store).report(folder / "report.html", episodes=1, replans=2)
        >>> page.read_text(encoding="utf-8")[:15].lower()
        '<!doctype html>'
        """
        from vla_attention.analyze.report.page import write_report
        from vla_attention.analyze.report.settings import ReportSettings

        usual = ReportSettings()
        shown = usual.episodes if episodes is None else episodes, usual.replans if replans is None else replans
        write_report(self.ask(**settings), Path(path), ReportSettings(*shown))
        return Path(path)

    def __repr__(self) -> str:
        root = self.attributes
        policy, recording = root.policy, root.recording
        untrained = ", UNTRAINED random weights" if policy.untrained else ""
        lines = [
            str(self),
            f"  stores   {listing([store.path for store in self.stores])}",
            f"  policy   {policy.name} ({policy.checkpoint_format}: {policy.checkpoint}){untrained}",
            f"  layers   {listing(recording.layer_labels, 40)}; denoise steps {listing(recording.denoise_steps, 40)}; "
            f"heads {listing(recording.heads, 40)}",
            f"  sites    {listing(f'{site.name} ({site.num_keys} keys)' for site in root.sites)}",
            "  ask with .ratios() .masses() .summary() .groups() .heads() .words() .objects() .time() .compare(other)",
            "           .overlay() .report(path) .to_xarray()",
        ]
        return "\n".join(lines)


def _frame(tables: object, name: str) -> pl.DataFrame:
    frame: pl.DataFrame = getattr(tables, name)
    return frame
