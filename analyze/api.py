"""The Python API: an opened store whose methods are the questions of `vla-attention` and return answers with tables.

The examples run as tests, with `store` and `other` being paths of small stores, `with_effects` and `replayed` those of
stores with recorded effects and of a replayed data set, and `folder` that of an empty folder.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, Unpack, overload

import polars as pl

from vla_attention.analyze.measures.question import KnownEpisodes, Question, ask
from vla_attention.analyze.measures.question_settings import SettingKeywords, settings_from_keywords
from vla_attention.analyze.stores.contents import episodes_table, one_line
from vla_attention.analyze.stores.selection import check_combinable
from vla_attention.schemas.errors import BadArgument
from vla_attention.schemas.stores.reader import Store, open_store
from vla_attention.schemas.stores.store_format import RootAttributes
from vla_attention.schemas.stores.store_url import store_place

if TYPE_CHECKING:
    import xarray

    from vla_attention.analyze.render.answer import Answer


def open_stores(stores: str | Path | Sequence[str | Path]) -> OpenStores:
    """See `va.open`."""
    paths = [stores] if isinstance(stores, (str, Path)) else list(stores)
    if not paths:
        raise BadArgument("No store was given; expected the path of a NAME.zarr, or several.")
    opened = tuple(open_store(store_place(path)) for path in paths)
    check_combinable(opened)
    return OpenStores(opened)


class OpenStores:
    """One or several stores, opened for questions. Made by `va.open`; holds the episodes that were complete then.

    Every question takes the keywords of `vla_attention.analyze.measures.question_settings.SettingKeywords`, reads only
    what it needs and returns an `Answer`, whose tables are polars frames: `answer["NAME"]`. Mistakes raise a
    `va.UserError` that says what exists.

    Attributes:
        stores: the stores, as `vla_attention.schemas.stores.reader` opens them.
        attributes: policy, protocol, recording and sites of the run, from the first store.

    >>> run = va.open(store)
    >>> run.attributes.recording.layers
    (0, 2)
    >>> print(run)
    OpenStores of 1 store: 4 episodes of 2 tasks (2 solved), 12 replans, suite made_up
    """

    def __init__(self, stores: Sequence[Store]) -> None:
        self.stores = tuple(stores)
        self._known: KnownEpisodes = {}

    @property
    def attributes(self) -> RootAttributes:
        """What the store says of its run; only the suite may differ between the stores."""
        return self.stores[0].attributes

    @property
    def episodes(self) -> pl.DataFrame:
        """One row per episode, from its attributes; reads no rows.

        >>> va.open(store).episodes.select("task_id", "episode_index", "success", "num_replans").rows()
        [(0, 0, False, 3), (0, 1, True, 3), (1, 0, False, 3), (1, 1, True, 3)]
        """
        return episodes_table(self.stores)

    def ask(self, **settings: Unpack[SettingKeywords]) -> Question:
        """The checked question that the tables answer; the modules of the package take it.

        >>> va.open(store).ask(grouping="cameras", layers=2).selection.blocks
        (2,)
        """
        return ask(self.stores, settings_from_keywords(**settings), self._known)

    def analyze(
        self,
        by: str | Sequence[str] = (),
        without_sinks: str | None = None,
        list: bool = False,
        **settings: Unpack[SettingKeywords],
    ) -> Answer:
        """Looks or reads? Tables "tasks_groups", "tasks", "episodes", "replans", "steps" and more, see docs/python.md.

        `by`: keep apart some of layer, head, denoise, replan, time, task, family, episode, outcome, camera: tables
        "by" and "by_groups". `without_sinks`: without keys that take far more than their share, "" for the usual rule;
        table "sinks". `list`: what the stores hold, and what the grouping takes of it.

        >>> run = va.open(store)
        >>> run.analyze(groups={"bowl": "word:bowl", "rest": "*"}, layers=2, denoise="last")["steps"].height
        12
        >>> run.analyze(by=["head"], grouping="cameras")["by_groups"]["head"].unique().sort().to_list()
        [0, 1]
        >>> masses = run.analyze(grouping="instruction")["steps_groups"]
        >>> masses.group_by("group").agg(pl.col("keys").mean()).filter(group="linguistic")["keys"].to_list()
        [5.0]
        """
        return self._answer("analyze", settings, by=_names(by), without_sinks=without_sinks, list=list)

    @overload
    def to_xarray(self, rows: Literal[False] = False, **settings: Unpack[SettingKeywords]) -> xarray.Dataset: ...

    @overload
    def to_xarray(self, rows: Literal[True], **settings: Unpack[SettingKeywords]) -> Iterator[xarray.Dataset]: ...

    def to_xarray(
        self, rows: bool = False, **settings: Unpack[SettingKeywords]
    ) -> xarray.Dataset | Iterator[xarray.Dataset]:
        """Masses of every head as labelled arrays; with `rows` the rows of one episode after the other.

        Needs the extra `xarray`. (episode, replan) is one axis `sample`; see `analyze/core/labelled_arrays.py`.

        >>> va.open(store).to_xarray(grouping="cameras")["mass"].dims
        ('sample', 'layer', 'denoise', 'head', 'group')
        >>> [episode["rows"].shape for episode in va.open(store).to_xarray(rows=True, layers=2)][0]
        (3, 1, 2, 2, 39)

        Raises:
            MissingDependency: xarray is not installed.
        """
        from vla_attention.analyze.core.labelled_arrays import masses_array, rows_of_episodes

        question = self.ask(**settings)
        return rows_of_episodes(question) if rows else masses_array(question)

    def language(self, **settings: Unpack[SettingKeywords]) -> Answer:
        """Does it listen? Tables "told_and_did", "told_episodes", "words"; "word_effects" where they were recorded."""
        return self._answer("language", settings)

    def failures(self, twins: str | Path | None = None, **settings: Unpack[SettingKeywords]) -> Answer:
        """Why did it fail? Tables "instead", "failures", "failures_by_task".

        `twins`: a store in which the same initial states are solved.
        """
        from vla_attention.schemas.stores.store_url import store_place

        return self._answer("failures", settings, twins=None if twins is None else store_place(str(twins)))

    def words(self, by: str | Sequence[str] = (), **settings: Unpack[SettingKeywords]) -> Answer:
        """Which words of the instruction are read; tables "words", "words_scale", "words_episodes".

        `by`: keep apart layer, head, denoise, replan, task, family or episode.

        >>> words = va.open(store).words(tasks=0)["words"]
        >>> sorted(words.filter(kind="word")["item"].to_list())
        ['bowl', 'on', 'plate', 'put', 'the']
        """
        return self._answer("words", settings, by=_names(by))

    def _answer(self, name: str, settings: SettingKeywords, **own: Any) -> Answer:
        from vla_attention.analyze.ask import answer_to
        from vla_attention.analyze.render.answer import Answer

        return Answer.of(answer_to(name, self.stores, settings_from_keywords(**settings), own, self._known))

    def objects(self, by: str | Sequence[str] = (), iou: bool = True, **settings: Unpack[SettingKeywords]) -> Answer:
        """Which objects are looked at; tables "objects", "pointing", "iou", each of them with "_episodes" too.

        `by`: keep apart layer, head, denoise, replan, time, task, family, episode or camera. `iou`: compare maps with
        the objects' masks, which takes most of the time.

        >>> objects = va.open(store).objects(iou=False)["objects"]
        >>> "akita_black_bowl_1" in objects["item"].to_list()
        True

        Raises:
            BadArgument: the stores hold no object masks.
        """
        return self._answer("objects", settings, by=_names(by), iou=iou)

    def compare(
        self,
        other: OpenStores | str | Path | Sequence[str | Path],
        allow_mismatch: str | Sequence[str] = (),
        names: tuple[str, str] = ("first", "other"),
        **settings: Unpack[SettingKeywords],
    ) -> Answer:
        """What changed from this run to another; paired where initial states and seeds are shared.

        Tables "differences", "words", "heads", "behaviour", "pairs", "runs" and more; of a rerun "moved".

        >>> differences = va.open(store).compare(other)["differences"]
        >>> differences.filter(scope="all", layer="layers_avg", quantity="success")["difference"].to_list()
        [0.0]

        Raises:
            MixedPolicies, RunsDiffer: the runs differ in more than their weights and `allow_mismatch` does not name it;
                see `vla_attention.analyze.core.runs`.
        """
        from vla_attention.analyze.ask import compared
        from vla_attention.analyze.core.runs import RunArgument
        from vla_attention.analyze.render.answer import Answer

        both = self, other if isinstance(other, OpenStores) else open_stores(other)
        runs = [RunArgument(name, tuple(one.path for one in run.stores)) for name, run in zip(names, both, strict=True)]
        return Answer.of(compared(runs, settings_from_keywords(**settings), _names(allow_mismatch)))

    def effects(self, by: str | Sequence[str] = (), **settings: Unpack[SettingKeywords]) -> Answer:
        """What the action depends on, as far as the run recorded it (`vla-attention capture --effects`).

        Tables "effects_items", "effects_summary", "effects_episodes", "effects" (every replan, condition and reader),
        "effects_time"; with a map of patches "maps_episodes", "maps_by", "maps_outcomes", "maps_summary",
        "maps_naming", "maps"; of a replayed data set "deviation", "deviation_dimensions", "deviation_attention",
        "deviation_replans". `by`: keep apart task, family, episode, replan or time.

        >>> rows = va.open(with_effects).effects()["effects"]
        >>> rows.filter(label="all pictures", reader="total").select("task_id", "replan").rows()[:2]
        [(0, 0), (0, 1)]
        >>> va.open(replayed).effects()["deviation"].filter(scope="all")["num_episodes"].to_list()
        [6]

        Raises:
            BadArgument: the stores hold neither effects nor a data set's actions.
        """
        return self._answer("effects", settings, by=_names(by))

    def overlay(
        self,
        episode: int | None = None,
        replans: int | Sequence[int] | None = None,
        cameras: str | Sequence[str] | None = None,
        outline: str | Sequence[str] = (),
        video: Literal["gif", "mp4"] | None = None,
        **settings: Unpack[SettingKeywords],
    ) -> Answer:
        """Attention on the pictures of some episodes; tables "overlay" (a row per picture) and "overlay_patches".

        Without `episode` and `replans`: two episodes, up to eight policy calls of each. `outline`: groups around whose
        patches lines are drawn, as "bowl=object:akita_black_bowl_1". `video`: with `.save(folder)` also a film.

        >>> va.open(store).overlay(tasks=1, replans=0)["overlay_patches"].height
        16
        """
        own = {
            "episode": episode,
            "replans": [replans] if isinstance(replans, int) else replans,
            "cameras": [cameras] if isinstance(cameras, str) else cameras,
            "outline": [outline] if isinstance(outline, str) else outline,
        }
        return self._answer("overlay", settings, **own, video=video)

    def report(
        self, path: str | Path, num_episodes: int = 2, num_replans: int = 8, **settings: Unpack[SettingKeywords]
    ) -> Path:
        """Write the self-contained HTML page of `vla-attention report`; returns its path.

        `path`: a folder, in which `report.html` is written, or a file that ends with .html. `num_episodes`: how many
        are shown with pictures; `num_replans`: how many of each.

        >>> page = va.open(store).report(folder / "report.html", num_episodes=1, num_replans=2)
        >>> page.read_text(encoding="utf-8")[:15].lower()
        '<!doctype html>'
        """
        from vla_attention.analyze.ask import write_page

        own = {"num_episodes": num_episodes, "num_replans": num_replans}
        return write_page("report", self.stores, settings_from_keywords(**settings), own, Path(path))

    def __str__(self) -> str:
        return f"OpenStores of {one_line(self.stores)}"

    #: At Python's prompt too.
    __repr__ = __str__


def _names(given: str | Sequence[str]) -> tuple[str, ...]:
    """One name, several with commas between them, or a sequence of names."""
    return tuple(part.strip() for part in given.split(",")) if isinstance(given, str) else tuple(given)
