"""`vla-attention capture parity`: cases pass in each of their formats, and every damaged case fails."""

import json
import shutil

import numpy as np
import pytest
from safetensors.torch import load_file, save_file

from tests.kit.pi_golden import GOLDEN, LARGE_GOLDEN
from vla_attention.capture.__main__ import main

CASES = {
    "pi05_batch2": ("openpi", "lerobot"),
    "pi0_batch2": ("orbax", "lerobot"),
}


def parity(capsys, *arguments):
    code = main(["parity", *map(str, arguments)])
    said = capsys.readouterr()
    return code, said.out, said.err.strip()


@pytest.fixture
def case(tmp_path):
    """A copy that a test may spoil."""
    folder = tmp_path / "case"
    shutil.copytree(GOLDEN / "pi05_batch2", folder)
    return folder


def edit(folder, file, change):
    arrays = dict(np.load(folder / file))
    change(arrays)
    np.savez(folder / file, **arrays)


@pytest.mark.parametrize("name", CASES)
def test_every_format_of_a_case_passes(name, capsys):
    code, out, _ = parity(capsys, GOLDEN / name, "--json")
    results = json.loads(out)
    assert code == 0
    assert tuple(result["format"] for result in results) == CASES[name]
    for result in results:
        assert result["passed"]
        assert 0 < result["actions_max"] < 3e-5
        assert 0 < result["attention_max"] < 3e-5
        table = np.array(result["attention_max_per_layer_and_step"])
        assert table.shape == (3, 10 if name == "pi05_batch2" else 5)
        assert table.max() == result["attention_max"]


@pytest.mark.thorough
@pytest.mark.parametrize("name", ["pi05_batch2", "pi05_full_layout", "pi0_batch2"])
def test_all_reference_checkpoints_pass(name, capsys):
    folder = LARGE_GOLDEN / name
    if not folder.is_dir():
        pytest.skip("the whole set of golden checkpoints is not beside this checkout")
    code, out, _ = parity(capsys, folder)
    assert code == 0, out
    assert out.count("within the limit") == 2 * sum((folder / f).is_dir() for f in FOLDERS)


FOLDERS = ("checkpoint", "checkpoint_openpi_torch", "checkpoint_lerobot")


def test_a_difference_fails_and_its_place_is_printed(case, capsys):
    def change(arrays):
        arrays["attn"][7, 2, 1, 4, 3, 20] += 1e-3

    edit(case, "expected.npz", change)
    code, out, _ = parity(capsys, case, "--format", "openpi")
    assert code == 1
    assert "attention  1.0e-03  BEYOND THE LIMIT" in out
    row = next(line for line in out.splitlines() if line.strip().startswith("2 "))
    assert row.split()[1 + 7] == "1.0e-03"
    assert parity(capsys, case, "--format", "openpi", "--limit", "2e-3")[0] == 0
    edit(case, "expected.npz", lambda arrays: arrays["attn"].fill(np.nan))
    code, out, _ = parity(capsys, case, "--format", "lerobot", "--json")
    assert code == 1
    assert json.loads(out)[0]["attention_max"] is None


def test_spoiled_weights_fail(case, capsys):
    file = case / "checkpoint_openpi_torch" / "model.safetensors"
    tensors = load_file(file)
    tensors["paligemma_with_expert.gemma_expert.model.layers.1.self_attn.q_proj.weight"] *= 1.01
    save_file(tensors, file)
    code, out, _ = parity(capsys, case)
    assert code == 1
    assert out.count("BEYOND THE LIMIT") == 2


def spoil(case, what):
    if what == "no case":
        (case / "case.json").unlink()

    elif what == "damaged":
        (case / "expected.npz").write_bytes((case / "expected.npz").read_bytes()[:1000])
