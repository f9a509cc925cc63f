"""What travels to another process: little, nothing that is open, and what comes back is the sender's own."""

from __future__ import annotations

import copyreg
from dataclasses import replace
from functools import partial

import pytest

from tests.kit.episode_work import damaged, defect, refused, seen
from tests.kit.questions import question_about
from vla_attention.analyze.heads.head_study import _measure
from vla_attention.analyze.measures.selected import resolve_all
from vla_attention.analyze.measures.steps import measure_episode
from vla_attention.analyze.stores import parcels
from vla_attention.analyze.stores.parcels import Parcel, VersionsDiffer, package_version, work
from vla_attention.schemas import errors
from vla_attention.schemas.stores.store_format import CorruptEpisode, StoreError
from vla_attention.testing.stores import write_store


@pytest.fixture(scope="module")
def question(tmp_path_factory):
    return question_about(write_store(tmp_path_factory.mktemp("parcels") / "a.zarr", episodes=3))


def done(function, item):
    parcel = Parcel.of(function, item)
    return parcel.result(work(parcel.content, package_version()))


def test_the_other_side_makes_episodes_anew_and_this_side_gets_its_own_back(question):
    item = question.selected[0]
    assert vars(item.episode).keys() > {"attributes", "seal"}  # it was read here
    back, episode, others, read = done(seen, item)
    assert back is item
    assert episode is item.episode
    assert (others, read) == (0, 0)


def test_a_function_of_an_episode_gives_the_same_arrays(question):
    resolved = resolve_all(question.grouping, question.selected, question.vocabulary)
    apart = replace(question.selection, per_head=True)
    measure = partial(_measure, apart=apart, site=question.site)
    for item, groups in zip(question.selected, resolved, strict=True):
        here = measure_episode(item, groups, apart, question.site)
        there = done(measure, (item, groups, None))
        assert there.item is item
        for name in ("mass", "valid_mass", "row_sum", "num_keys", "num_valid"):
            assert getattr(here, name).tobytes() == getattr(there, name).tobytes()
            # Sums over arrays in another order in memory have other last bits.
            assert getattr(here, name).flags.c_contiguous


def test_a_parcel_does_not_grow_with_the_store(question):
    item = question.selected[0]
    crowded = replace(item, store=replace(item.store, episodes=item.store.episodes * 1000))
    assert len(Parcel.of(seen, crowded).content) == len(Parcel.of(seen, item).content)


def test_a_parcel_names_its_episode(question):
    assert Parcel.of(seen, question.selected[1]).name == question.selected[1].episode.name


def test_a_users_mistake_comes_back_and_a_defect_is_raised_there():
    with pytest.raises(CorruptEpisode, match=r"Episode 5 is damaged\."):
        done(damaged, 5)
    with pytest.raises(ZeroDivisionError):
        done(defect, 5)


def test_another_version_is_refused(question):
    with pytest.raises(VersionsDiffer, match=r"this process 0\.0\.7: install the same on both"):
        work(Parcel.of(seen, question.selected[0]).content, "0.0.7")


def test_a_store_that_a_worker_does_not_see_is_named(question, tmp_path):
    item = question.selected[0]
    elsewhere = replace(item, store=replace(item.store, path=tmp_path / "gone.zarr"))
    with pytest.raises(StoreError, match=r"does not see .*gone\.zarr; stores must be in a folder"):
        done(seen, elsewhere)
    assert parcels._check_visible.cache_info().misses


@pytest.fixture
def ways_of_pickling():
    """What a test registers for pickling is gone after it. The dictionary stays the same: `pickle` keeps it."""
    before = dict(copyreg.dispatch_table)
    yield
    copyreg.dispatch_table.clear()
    copyreg.dispatch_table.update(before)


@pytest.mark.parametrize("with_dask", [False, True])
def test_every_error_for_users_survives_the_way(with_dask, ways_of_pickling):
    if with_dask:  # it registers another way for every kind of exception that there is
        pytest.importorskip("tblib.pickling_support").install()
    kinds = [errors.UserError]
    while kinds:
        kind = kinds.pop()
        kinds += kind.__subclasses__()
        with pytest.raises(kind, match=r"^one sentence$") as raised:
            done(refused, kind)
        assert type(raised.value) is kind
