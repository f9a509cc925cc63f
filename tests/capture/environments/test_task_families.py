"""Families of tasks by sentence template: every task of every suite has one, and the templates are sentences."""

from __future__ import annotations

from collections import Counter

import pytest

from vla_attention.capture.environments.suites import SUITES, find_suite, list_tasks
from vla_attention.capture.environments.task_families import sentence_template

SIZES = {
    "libero_spatial": [10],
    "libero_object": [10],
    "libero_goal": [1, 5, 1, 1, 1, 1],
    "libero_10": [3, 1, 2, 1, 1, 1, 1],
    "libero_90": [4, 1, 5, 3, 4, 1, 23, 2, 2, 2, 1, 1, 2, 1, 1, 27, 2, 1, 3, 3, 1],
    "libero_pro_goal_task": [1, 4, 2, 1, 1, 1],
    "libero_pro_10_task": [3, 1, 2, 1, 1, 1, 1],
    "robosuite": [1, 1, 4, 2],
    "cubes": [3, 6, 3, 3, 2],
    "cubes_harder": [3, 6, 3, 3, 2, 6],
    "cubes_marked": [3, 3, 3, 3],
    "cubes_mark_only": [3, 3, 3, 3],
}


def families(name: str) -> Counter[str]:
    return Counter(task.task_family for task in list_tasks(find_suite(name)))


@pytest.mark.parametrize("suite", [suite.name for suite in SUITES])
def test_every_task_is_in_a_family(suite):
    found = families(suite)
    assert "" not in found
    assert list(found.values()) == SIZES[suite if suite in SIZES else find_suite(suite).perturbs]


@pytest.mark.parametrize(
    ("instruction", "family"),
    [
        ("put the wine bottle on top of the cabinet", "put A on B"),
        ("open the top drawer and put the bowl inside", "open A and put B in it"),
        ("put the black bowl in the bottom drawer of the cabinet and close it", "put A in B and close it"),
        ("put both moka pots on the stove", "put both A on B"),
        ("turn on the stove", "turn on A"),
        ("pick up the ketchup and put it in the basket", "pick up A and place it in B"),
        ("fold the towel", ""),
    ],
)
def test_the_first_template_that_fits_is_the_family(instruction, family):
    assert sentence_template(instruction) == family
