"""The overlay of one episode from stores and settings: episode, cameras, replans and outlined groups are chosen."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import polars as pl

from vla_attention.analyze.measures.question import Question, ask
from vla_attention.analyze.measures.question_settings import AnalysisSettings
from vla_attention.analyze.measures.selected import find_episode
from vla_attention.analyze.overlay.overlay_data import (
    EpisodeOverlay,
    camera_names,
    check_outlines,
    chosen_replans,
    episode_overlay,
    outline_grouping,
    overlay_table,
    ratios_of,
)
from vla_attention.analyze.stores.selection import heads_text, site_that
from vla_attention.schemas.errors import listing
from vla_attention.schemas.safe_text import file_part
from vla_attention.schemas.stores.reader import Store


@dataclass(frozen=True)
class OverlayStudy:
    """One episode's overlay.

    Attributes:
        question: what was asked; its grouping gives the ratio, and has none of the outlined groups.
        overlay: the episode's attention on its cameras, all replans.
        replans: the replans to show.
    """

    question: Question
    overlay: EpisodeOverlay
    replans: tuple[int, ...]

    @property
    def table(self) -> pl.DataFrame:
        """The numbers of the shown replans; see `overlay_table`."""
        return overlay_table(self.overlay, self.replans)

    @property
    def whole_table(self) -> pl.DataFrame:
        """The numbers of all replans; see `overlay_table`."""
        return overlay_table(self.overlay, range(self.overlay.num_replans))

    @property
    def averaged_over(self) -> str:
        """The layers, denoise steps and heads that were averaged, in words."""
        chosen = self.question.selection
        _, num_heads = self.question.stores[0].attributes.size_of(self.question.site)
        return (
            f"mean over layers {listing(chosen.layer_labels, 8)}, denoise steps {listing(chosen.denoise_steps, 8)}, "
            f"{heads_text(chosen, num_heads)}"
        )

    @property
    def stem(self) -> str:
        """Name of the files, without an ending; with the suite where there are several stores."""
        item = self.overlay.item
        suite = f"{file_part(item.store.suite)}_" if len(self.question.stores) > 1 else ""
        return f"overlay_{suite}{item.episode.name}"


def study_overlay(
    stores: Sequence[Store],
    settings: AnalysisSettings,
    *,
    task: int | None = None,
    episode: int | None = None,
    cameras: Sequence[str] | None = None,
    replans: Sequence[int] | None = None,
    most_replans: int | None = None,
) -> OverlayStudy:
    """Read one episode's attention on its pictures.

    Args:
        stores: one or several stores.
        settings: what is averaged; `groups` are outlined, and the ratio is that of `grouping`.
        task: task of the episode (default: the first one).
        episode: its number (default: the task's first one).
        cameras: which cameras (default: all that the policy sees).
        replans: which replans (default: `most_replans` of them from the first to the last, or all).
        most_replans: see `replans`.

    Raises:
        UserError: a subclass that says which name or number does not exist.
    """
    outlined = outline_grouping(settings.groups)
    seeing = site_that(stores[0].attributes, settings.site, lambda site: bool(site.pictured))
    question = ask(stores, replace(settings, groups=(), site=seeing or settings.site))
    check_outlines(question, outlined)
    shown = camera_names(question, cameras)
    item = find_episode(question.selected, task, episode)
    overlay = episode_overlay(question, item, shown, ratios_of(question, item), outlined)
    return OverlayStudy(question, overlay, chosen_replans(overlay, replans, most_replans or overlay.num_replans))
