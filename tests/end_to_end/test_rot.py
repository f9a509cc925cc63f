"""Damaged files of every kind: `verify` names each, and no analysis gives other numbers.

`benchmarks/reliability.py rot` tries a hundred times as many.
"""

from __future__ import annotations

import pytest

from tests.kit.damages import KINDS, Subject, draw, make_subjects, tried


@pytest.fixture(scope="module")
def subjects(tmp_path_factory) -> dict[str, Subject]:
    return make_subjects(tmp_path_factory.mktemp("rot"))


def test_every_file_of_a_store_has_a_kind(subjects):
    assert {kind for subject in subjects.values() for kind in subject.files()} == {kind.name for kind in KINDS}


@pytest.mark.parametrize("kind", [kind.name for kind in KINDS])
def test_damage_is_named_and_gives_no_other_number(subjects, kind):
    having = [subject for subject in subjects.values() if kind in subject.files()]
    assert tried(having[-1], draw(having[-1], kind, 0)).problems == []
