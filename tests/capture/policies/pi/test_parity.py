"""`vla-attention capture parity`: cases pass in each of their formats, and every damaged case fails."""

import json
import shutil

import numpy as np
import pytest

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


def spoil(case, what):
    if what == "no case":
        (case / "case.json").unlink()

    elif what == "damaged":
        (case / "expected.npz").write_bytes((case / "expected.npz").read_bytes()[:1000])
