"""How a test asks a question about stores."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from msgspec import structs

from vla_attention.analyze.measures.question import Question, ask
from vla_attention.analyze.measures.question_settings import AnalysisSettings
from vla_attention.schemas.groupings.grouping import Grouping
from vla_attention.schemas.stores.reader import Store, StoredEpisode, open_store


def question_about(
    stores: Path | Store | Sequence[Store], grouping: Grouping | str | None = None, **settings: Any
) -> Question:
    """The question about one store or several, with fields of `AnalysisSettings`.

    `grouping`: a built-in one by its name, or a `Grouping` that has neither a name nor a file.
    """
    if isinstance(stores, Path):
        stores = open_store(stores)
    opened = [stores] if isinstance(stores, Store) else list(stores)
    if isinstance(grouping, str):
        settings["grouping"] = grouping
    question = ask(opened, AnalysisSettings(**settings))
    return replace(question, grouping=grouping) if isinstance(grouping, Grouping) else question


def with_attributes(episode: StoredEpisode, **changes: Any) -> StoredEpisode:
    """An episode whose attributes say something else than its files."""

    class Changed(StoredEpisode):
        attributes = property(lambda self: structs.replace(StoredEpisode.attributes.func(self), **changes))

    return Changed(episode.folder, episode.name, episode.run)
