"""Our numbers against those that the reference implementation computed."""

from __future__ import annotations

import json
import shutil

import numpy as np
import pytest
import torch

from tests.kit.cosmos_helpers import GOLDEN, LARGE_GOLDEN
from vla_attention.capture.policies.cosmos.case import read_case
from vla_attention.capture.policies.cosmos.parity import describe, run_case, run_parity
from vla_attention.capture.policies.parity_case import UnusableCase

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


def change_facts(folder, **changes):
    facts = json.loads((folder / "case.json").read_text())
    (folder / "case.json").write_text(json.dumps({**facts, **changes}))


def test_a_kind_that_does_not_exist_is_refused(case_copy):
    change_facts(case_copy, kind="sample")
    with pytest.raises(UnusableCase, match=r"kind 'sample'; expected dit_forward, policy_sample"):
        read_case(case_copy)


def test_a_network_that_is_not_this_one_is_refused(case_copy):
    facts = json.loads((case_copy / "case.json").read_text())["net_config"]
    change_facts(case_copy, net_config={**facts, "patch_temporal": 2})
    with pytest.raises(UnusableCase, match="patch_temporal 2; the transformer here has patch_temporal 1"):
        read_case(case_copy)
    change_facts(case_copy, net_config={**facts, "num_heads": 4})
    with pytest.raises(UnusableCase, match="num_heads 4, but the weights have 2"):
        run_case(case_copy)


def test_missing_pieces_are_named(case_copy, tmp_path):
    with pytest.raises(UnusableCase, match=r"has no case\.json"):
        read_case(tmp_path)
    (case_copy / "inputs.npz").unlink()
    with pytest.raises(UnusableCase, match=r"inputs.npz', which a case needs"):
        read_case(case_copy)
    np.savez(case_copy / "inputs.npz", latents=np.zeros(3))
    with pytest.raises(UnusableCase, match="has no timesteps, condition_mask"):
        read_case(case_copy)


def test_latents_that_are_no_whole_number_of_patches_are_refused(case_copy):
    with np.load(case_copy / "inputs.npz") as stored:
        latents = stored["latents"][..., :9]
        mask = stored["condition_mask"][..., :9]
    change_arrays(case_copy / "inputs.npz", latents=latents, condition_mask=mask)
    with pytest.raises(ValueError, match=r"6 x 9 cannot be cut into patches of 2 x 2"):
        run_case(case_copy)


def test_rows_do_not_depend_on_what_is_recorded(case_copy):
    case = read_case(case_copy)
    dit = case.build_dit("cpu")
    names = ("latents", "timesteps", "condition_mask", "padding_mask", "text_embeddings")
    given = [torch.from_numpy(case.inputs[name]) for name in names]
    with torch.no_grad():
        assert torch.equal(dit(*given), run_forward_observed(dit, given))


def run_forward_observed(dit, given):
    from vla_attention.capture.policies.cosmos.parity import EverythingObserver

    return dit(*given, EverythingObserver())
