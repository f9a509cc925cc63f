"""What torch.save writes is read, of each published kind; tests/thorough/hostile_checkpoints has what is refused."""

from __future__ import annotations

import io
import zipfile

import numpy as np
import pytest
import torch
from torch import nn

from vla_attention.capture.environments.libero import UnusableTask, load_initial_states
from vla_attention.capture.policies.cosmos.tensor_files import read_tensors
from vla_attention.capture.torch_files import load_torch, tensor_problem
from vla_attention.schemas.errors import BadArgument

SHARED = torch.arange(10.0)
CONTENTS = {
    "state of a module": nn.Sequential(nn.Linear(2, 3), nn.LayerNorm(3)).state_dict(),
    "types": {name: torch.ones(3).to(getattr(torch, name)) for name in ("bfloat16", "float64", "int8", "bool")},
    "views": {"a": SHARED[2:5], "b": SHARED[::2], "c": torch.ones(4, 4).t(), "d": torch.zeros(0), "e": torch.tensor(3)},
}


@pytest.mark.parametrize("name", CONTENTS)
def test_what_torch_saves_is_read(tmp_path, name):
    torch.save(CONTENTS[name], tmp_path / "a.pt")
    found = load_torch(tmp_path / "a.pt", BadArgument)
    assert not tensor_problem(found.values())
    assert found.keys() == CONTENTS[name].keys()
    for key, value in CONTENTS[name].items():
        assert found[key].dtype == value.dtype
        assert torch.equal(found[key], value)


def test_transformer_engine_s_extra_state_is_read(tmp_path):
    """Weights of Cosmos Policy have bytes beside their tensors, as Transformer Engine saves its state."""
    state = {"net.a": torch.ones(2), "net.a._extra_state": io.BytesIO(b"\xff\x00" * 100)}
    torch.save(state, tmp_path / "a.pt")
    found = read_tensors(tmp_path / "a.pt")
    assert torch.equal(found["net.a"], torch.ones(2))
    assert found["net.a._extra_state"].getvalue() == b"\xff\x00" * 100
    with pytest.raises(BadArgument, match=r"a\.pt' .*_?io\.BytesIO"):
        load_torch(tmp_path / "a.pt", BadArgument)


def test_initial_states_of_libero_are_read(tmp_path):
    """An array of numpy, which torch.save pickles by numpy's own constructors."""
    states = np.random.default_rng(0).normal(size=(50, 77))
    torch.save(states, tmp_path / "a.pruned_init")
    np.testing.assert_array_equal(load_initial_states(tmp_path / "a.pruned_init"), states)
    # numpy 1, with which LIBERO's were written, has its modules under another name
    with zipfile.ZipFile(tmp_path / "a.pruned_init") as now, zipfile.ZipFile(tmp_path / "b.pruned_init", "w") as then:
        for name in now.namelist():
            then.writestr(name, now.read(name).replace(b"numpy._core.", b"numpy.core."))
    np.testing.assert_array_equal(load_initial_states(tmp_path / "b.pruned_init"), states)
    torch.save(np.array([object()]), tmp_path / "c.pruned_init")
    with pytest.raises(UnusableTask, match=r"c.pruned_init' "):
        load_initial_states(tmp_path / "c.pruned_init")


def test_files_before_pytorch_1_6_are_refused(tmp_path):
    torch.save({"a": torch.ones(2)}, tmp_path / "a.pt", _use_new_zipfile_serialization=False)
    with pytest.raises(BadArgument, match=r"a\.pt'"):
        load_torch(tmp_path / "a.pt", BadArgument)


def test_a_tensor_has_its_numbers_in_its_file():
    assert "shape (1000000, 1000000)" in tensor_problem([torch.zeros(1).expand(10**6, 10**6)])
