"""What an analysis keeps in memory of an episode is far less than what it measures of it: thousands of episodes fit."""

from __future__ import annotations

import gc
import tracemalloc
from collections.abc import Callable
from pathlib import Path

import polars as pl
import pytest

from vla_attention.analyze.heads.head_study import study_heads
from vla_attention.analyze.heads.row_metrics import RowOptions
from vla_attention.analyze.heads.text import heads_sections
from vla_attention.analyze.measures.question import ask
from vla_attention.analyze.measures.question_settings import AnalysisSettings
from vla_attention.analyze.objects.object_study import study_objects
from vla_attention.analyze.objects.text import objects_sections
from vla_attention.analyze.ratios.analysis import analyse, write_tables
from vla_attention.analyze.show.answer import text_of
from vla_attention.analyze.show.output_files import write_parquet
from vla_attention.analyze.words.word_study import study_words
from vla_attention.schemas.stores.reader import Store, open_store
from vla_attention.testing.stores import StoreSpec, write_store

pytestmark = pytest.mark.thorough

#: Large enough that an array or a table with a number for each replan and layer is seen.
SPEC = StoreSpec(
    replans=64,
    layers=(0, 1, 2, 3, 4, 5),
    num_layers=6,
    heads=(0, 1, 2, 3),
    contributions=True,
    frames=False,
    tasks=(0,),
)
FEW, MANY = 1, 3
#: Kilobytes an episode beyond its attributes, seal and tokens: its rows in tables of episodes. Its masses are 43, its
#: rows in a table of replans 70, in one of rows 300, its masks of objects 100.
MOST_KEPT = 25
#: The same where tables of episodes are on disk.
MOST_KEPT_OF = dict.fromkeys(("words", "heads", "objects"), 18)


def _ratios(store: Store, folder: Path, settings: AnalysisSettings) -> object:
    analysis = analyse(ask([store], settings))
    write_tables(analysis, folder)
    return analysis


def _words(store: Store, folder: Path) -> object:
    study = study_words([store], AnalysisSettings())
    return study, study.summary


def _heads(store: Store, folder: Path) -> object:
    study = study_heads(ask([store], AnalysisSettings()), RowOptions())
    write_parquet(folder, **study.files())
    return study, text_of(heads_sections(study, 5))


def _objects(store: Store, folder: Path) -> object:
    study = study_objects([store], AnalysisSettings(), keep_steps=True)
    write_parquet(folder, **study.files())
    return study, text_of(objects_sections(study))


def _question(store: Store, _: Path) -> object:
    return ask([store], AnalysisSettings())


COMMANDS: dict[str, Callable[[Store, Path], object]] = {
    "default": lambda store, folder: _ratios(store, folder, AnalysisSettings()),
    "words in a grouping": lambda store, folder: _ratios(
        store, folder, AnalysisSettings(groups=("bowl=word:bowl", "v=role:image"), ratio="v/bowl")
    ),
    "objects in a grouping": lambda store, folder: _ratios(store, folder, AnalysisSettings(grouping="objects")),
    "words": _words,
    "heads": _heads,
    "objects": _objects,
}


@pytest.fixture(scope="module")
def stores(tmp_path_factory) -> dict[int, Path]:
    folder = tmp_path_factory.mktemp("stores")
    return {number: write_store(folder / f"{number}.zarr", spec=SPEC, episodes=number) for number in (FEW, MANY)}


@pytest.fixture(scope="module")
def of_question(stores, tmp_path_factory) -> float:
    return kept_of_an_episode(_question, stores, tmp_path_factory.mktemp("question"))


def kept_bytes(command: Callable[[Store, Path], object], path: Path, folder: Path) -> int:
    """Bytes of Python's objects and of arrays, as tracemalloc counts them, and of polars' frames."""
    gc.collect()
    tracemalloc.start()
    result = command(open_store(path), folder)
    gc.collect()
    counted = tracemalloc.get_traced_memory()[0]
    tracemalloc.stop()
    frames = [thing for thing in gc.get_objects() if isinstance(thing, pl.DataFrame)]
    assert result is not None
    return counted + sum(int(frame.estimated_size()) for frame in frames)


def least_kept(command: Callable[[Store, Path], object], path: Path, folder: Path) -> int:
    measured: list[int] = []
    while len(measured) < 6:
        measured.append(kept_bytes(command, path, folder))
        least, *others = sorted(measured)
        if others and others[0] - least < 4000:
            break
    return min(measured)


def kept_of_an_episode(command: Callable[[Store, Path], object], stores: dict[int, Path], folder: Path) -> float:
    """Kilobytes: what three episodes keep more than one. Each is measured until two measurements agree within 4 kB,
    and the least counts: what modules remember, and threads that tests before this one left, only add to it.
    """
    kept = {number: least_kept(command, path, folder) for number, path in stores.items()}
    return (kept[MANY] - kept[FEW]) / (MANY - FEW) / 1000


@pytest.mark.parametrize(("name", "cached"), [*((name, False) for name in COMMANDS), ("default", True)])
def test_little_is_kept_of_an_episode(stores, of_question, tmp_path, monkeypatch, name, cached):
    monkeypatch.setenv("VLA_CACHE", str(tmp_path / "cache") if cached else "off")
    assert of_question < 60
    found = kept_of_an_episode(COMMANDS[name], stores, tmp_path)
    assert found - of_question < MOST_KEPT_OF.get(name, MOST_KEPT)
