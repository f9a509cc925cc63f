"""Our numbers against those that the reference implementation computed."""

from __future__ import annotations

import json
import shutil

import numpy as np
import pytest

from tests.kit.cosmos_helpers import GOLDEN, LARGE_GOLDEN
from vla_attention.capture.policies.cosmos.parity import describe, run_case, run_parity

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


@pytest.fixture
def case_copy(tmp_path):
    return shutil.copytree(GOLDEN / "dit_batch2_T5_rect", tmp_path / "case")


def change_arrays(path, **changes):
    with np.load(path) as stored:
        arrays = dict(stored)
    np.savez(path, **{**arrays, **changes})


def test_a_difference_is_reported_where_it_begins(case_copy, capsys):
    with np.load(case_copy / "expected.npz") as stored:
        wrong = {name: stored[name] + np.float32(1e-3) for name in ("cross_attn_probs_01", "output")}
    change_arrays(case_copy / "expected.npz", **wrong)
    report = run_case(case_copy)
    assert report.begins == "cross_attn_probs_01"
    assert [stage.stage for stage in report.stages if not stage.passed] == ["cross_attn_probs_01", "output"]
    assert run_parity(case_copy) == 1
    assert "BEYOND THE LIMITS, first at 'cross_attn_probs_01'" in capsys.readouterr().out
    assert run_parity(case_copy, as_json=True) == 1
    (found,) = json.loads(capsys.readouterr().out)
    assert found["begins"] == "cross_attn_probs_01"


def test_what_is_not_a_number_does_not_pass(case_copy):
    with np.load(case_copy / "inputs.npz") as stored:
        latents = stored["latents"].copy()
    latents[0, 0, 0, 0, 0] = np.nan
    change_arrays(case_copy / "inputs.npz", latents=latents)
    report = run_case(case_copy)
    assert not report.passed
    assert report.begins == "self_attn_probs_00"
