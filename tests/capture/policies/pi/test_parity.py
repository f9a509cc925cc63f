"""What openpi's JAX code computed, and what a pi model here computes of the same, in every checkpoint format."""

from __future__ import annotations

import json
import shutil

import numpy as np
import pytest

from tests.kit.parity import main
from tests.kit.pi_golden import GOLDEN, LARGE_GOLDEN
from tests.kit.pi_parity import CHECKPOINT_FOLDERS

CASES = {
    "pi05_batch2": ["openpi", "lerobot"],
    "pi0_batch2": ["orbax", "lerobot"],
}


@pytest.mark.parametrize("name", CASES)
def test_every_format_of_a_case_passes(name, capsys):
    assert main([str(GOLDEN / name), "--json"]) == 0
    results = json.loads(capsys.readouterr().out)
    assert [result["format"] for result in results] == CASES[name]
    for result in results:
        assert result["passed"]
        assert 0 < result["actions_max"] < 3e-5
        assert 0 < result["attention_max"] < 3e-5
        table = np.array(result["attention_max_per_layer_and_step"])
        assert table.shape == (3, 10 if name == "pi05_batch2" else 5)
        assert table.max() == result["attention_max"]


def test_other_numbers_are_beyond_the_limit(tmp_path):
    folder = shutil.copytree(GOLDEN / "pi05_batch2", tmp_path / "case")
    shutil.rmtree(folder / "checkpoint_lerobot")
    with np.load(folder / "expected.npz") as stored:
        expected = dict(stored)
    expected["attn"][0, 0, 0, 0, 0, 0] += 0.01
    np.savez(folder / "expected.npz", **expected)
    assert main([str(folder)]) == 1


@pytest.mark.thorough
@pytest.mark.parametrize("name", ["pi05_batch2", "pi05_full_layout", "pi0_batch2"])
def test_all_reference_checkpoints_pass(name, capsys):
    folder = LARGE_GOLDEN / name
    if not folder.is_dir():
        pytest.skip("the whole set of golden checkpoints is not beside this checkout")
    assert main([str(folder)]) == 0
    formats = sum((folder / inner).is_dir() for inner, _ in CHECKPOINT_FOLDERS.values())
    assert capsys.readouterr().out.count("within the limit") == 2 * formats
