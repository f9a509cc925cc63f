"""Our numbers against those that the reference implementation computed."""

from __future__ import annotations

import pytest

from tests.kit.cosmos_helpers import GOLDEN, LARGE_GOLDEN
from tests.kit.cosmos_parity import describe, run_case

CASES = [path.name for path in sorted(GOLDEN.iterdir()) if path.is_dir()]
LARGE_CASES = ["dit_libero_T9", "policy_T9_64px", "policy_T9_224px_slim"]


@pytest.mark.parametrize("name", CASES)
def test_the_cases_in_the_repository_are_met(name):
    pytest.importorskip("diffusers")
    report = run_case(GOLDEN / name)
    assert report.passed, describe(report)


@pytest.mark.thorough
@pytest.mark.parametrize("name", LARGE_CASES)
def test_the_cases_beside_the_checkout_are_met(name):
    if not (LARGE_GOLDEN / name).is_dir():
        pytest.skip("the larger golden cases are not beside this checkout")
    pytest.importorskip("diffusers")
    report = run_case(LARGE_GOLDEN / name)
    assert report.passed, describe(report)
