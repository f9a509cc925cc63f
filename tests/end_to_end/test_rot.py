"""Damaged files of every kind: `verify` names each, and no analysis gives other numbers.

`benchmarks/reliability.py rot` tries a hundred times as many.
"""

from __future__ import annotations

import pytest

from tests.kit.damages import ACTIONS, KINDS, Damage, Subject, damaged, draw, kind_of, make_subjects, same, tried
from tests.kit.races import file_digests

#: Damages of each kind of file.
_DAMAGES = 2


@pytest.fixture(scope="module")
def subjects(tmp_path_factory) -> dict[str, Subject]:
    return make_subjects(tmp_path_factory.mktemp("rot"))


def test_every_file_of_a_store_has_a_kind(subjects):
    assert {kind for subject in subjects.values() for kind in subject.files()} == {kind.name for kind in KINDS}


@pytest.mark.parametrize("kind", [kind.name for kind in KINDS])
def test_damage_is_named_and_gives_no_other_number(subjects, kind):
    having = [subject for subject in subjects.values() if kind in subject.files()]
    for number in range(_DAMAGES):
        subject = having[number % len(having)]
        assert tried(subject, draw(subject, kind, number)).problems == []


def test_a_damage_is_undone_and_changes_something(subjects):
    subject = subjects["joint"]
    before = file_digests(subject.path)
    what = set()
    for number in range(60):
        damage = draw(subject, "rows", number)
        what.add(next(action for action in ACTIONS if damage.what.startswith(action)))
        with damaged(subject, damage):
            assert file_digests(subject.path) != before
        assert file_digests(subject.path) == before
    assert what == set(ACTIONS)


def test_what_nobody_notices_is_a_problem(subjects):
    """The check itself: a file that is as it was is neither named nor refused."""
    subject = subjects["joint"]
    path = subject.files()["rows"][0]
    noticed = tried(subject, Damage(kind_of(path), path, "nothing", (subject.path / path).read_bytes()))
    assert set(noticed.analyses.values()) == {"same"}
    assert noticed.problems == [f"nothing: {path}: verify ended with 0 and printed {noticed.verify!r}"]


def test_other_numbers_are_different(subjects):
    numbers = subjects["joint"].numbers
    assert same(numbers["spans", "joint"], numbers["spans", "joint"])
    assert not same(numbers["spans", "joint"], subjects["joint-sites"].numbers["spans", "self"])
    assert not same({"a": numbers["rest", "joint"]["task000_episode000/state"]}, {"a": None})
