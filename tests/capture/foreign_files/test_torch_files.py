"""What torch.save writes is read, in both of its formats; tests/thorough/hostile_checkpoints has what is refused."""

from __future__ import annotations

import io

import numpy as np
import pytest
import torch
from torch import nn

from vla_attention.capture.foreign_files.pickles import ARRAYS, TENSORS, PickleRefused
from vla_attention.capture.foreign_files.torch_files import check_tensors, load_torch

MODULE = nn.Sequential(nn.Linear(2, 3), nn.LayerNorm(3))
SHARED = torch.arange(10.0)
CONTENTS = {
    "state of a module": MODULE.state_dict(),
    "extra state": {"a": torch.ones(2), "x": io.BytesIO(b"\xff\x00" * 100)},
    "types": {name: torch.ones(3).to(getattr(torch, name)) for name in ("bfloat16", "float64", "int8", "bool")},
    "views": {"a": SHARED[2:5], "b": SHARED[::2], "c": torch.ones(4, 4).t(), "d": torch.zeros(0), "e": torch.tensor(3)},
    "a training": {"a": torch.ones(1), "state": {0: {"step": torch.tensor(1.0)}}, "groups": [{"betas": (0.9, 0.99)}]},
}


@pytest.mark.parametrize("new", [True, False])
@pytest.mark.parametrize("name", CONTENTS)
def test_what_torch_saves_is_read(tmp_path, name, new):
    path = tmp_path / "a.pt"
    torch.save(CONTENTS[name], path, _use_new_zipfile_serialization=new)
    with torch.serialization.safe_globals([io.BytesIO]):
        expected = torch.load(path, weights_only=True)
    for source in (path, path.open("rb")):
        found = load_torch(source, TENSORS, [io.BytesIO])
        check_tensors(found.values())
        assert found.keys() == expected.keys()
        for key, value in expected.items():
            if isinstance(value, torch.Tensor):
                assert found[key].dtype == value.dtype
                assert torch.equal(found[key], value)
            elif not isinstance(value, io.BytesIO):
                assert found[key] == value


@pytest.mark.parametrize("new", [True, False])
@pytest.mark.parametrize("dtype", ["<f8", ">f8"])
def test_arrays_are_read(tmp_path, dtype, new):
    array = np.arange(12).reshape(3, 4).astype(dtype)
    torch.save(array, tmp_path / "a", _use_new_zipfile_serialization=new)
    rebuild = np.empty(0).__reduce__()[0]
    names = [(rebuild, "numpy.core.multiarray._reconstruct"), rebuild, np.ndarray, np.dtype, type(np.dtype(dtype))]
    np.testing.assert_array_equal(load_torch(tmp_path / "a", ARRAYS, names), array)
    with pytest.raises(PickleRefused, match=r"asks for numpy\S*_reconstruct"):
        load_torch(tmp_path / "a", TENSORS, names)
