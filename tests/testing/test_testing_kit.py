"""The shipped kit: what it says a store holds is what any reader finds, and it imports neither torch nor hypothesis."""

from __future__ import annotations

import json
import subprocess
import sys

import numpy as np
import pytest
import zarr

import vla_attention.testing as kit
from vla_attention.schemas.errors import MissingDependency
from vla_attention.schemas.stores.store_format import NUMBERS


@pytest.mark.parametrize(
    "spec",
    [
        kit.StoreSpec(),
        kit.StoreSpec(mantissa_bits=23, queries="all", frames=False, coverage=False, tasks=(4,), episodes=1),
        kit.StoreSpec(tokens=kit.libero_tokens(2), layers=(1,), heads=(0,), tasks=(0,), episodes=1),
    ],
    ids=["default", "all queries, no pictures", "libero"],
)
def test_plain_zarr_finds_what_is_expected(tmp_path, spec):
    path = kit.write_store(tmp_path / "a.zarr", spec=spec)
    kit.assert_whole(path)
    root = zarr.open_group(path, mode="r")
    assert root.attrs["recording"]["layers"] == list(spec.layers)
    for task, episode in spec.names:
        group = root[f"episodes/task{task:03d}_episode{episode:03d}"]
        expected = kit.expected_arrays(spec, task, episode)
        assert set(group.attrs["arrays"]) == set(expected) - set(NUMBERS)
        for name, values in expected.items():
            if name in NUMBERS:
                np.testing.assert_array_equal(np.array(group.attrs[name], dtype=values.dtype), values, err_msg=name)
                continue
            assert group[name].dtype == values.dtype, name
            np.testing.assert_array_equal(group[name][:], values, err_msg=name)


def test_a_damaged_store_is_not_whole(tmp_path):
    path = kit.write_store(tmp_path / "a.zarr", tasks=(0,), episodes=1)
    file = path / "episodes/task000_episode000/zarr.json"
    file.write_text(file.read_text().replace("bowl", "bowk"))
    with pytest.raises(AssertionError, match=r"task000_episode000.*zarr\.json does not agree with its seal"):
        kit.assert_whole(path)


def test_making_a_store_imports_no_torch_and_no_hypothesis(tmp_path):
    code = (
        "import json, sys\n"
        "from pathlib import Path\n"
        "import vla_attention.testing as kit\n"
        "kit.assert_whole(kit.write_store(Path(sys.argv[1]), contributions=True, tasks=(0,), episodes=1))\n"
        "print(json.dumps([name for name in ('torch', 'hypothesis', 'polars', 'mujoco') if name in sys.modules]))\n"
    )
    done = subprocess.run([sys.executable, "-c", code, tmp_path / "a.zarr"], capture_output=True, text=True, check=True)
    assert json.loads(done.stdout) == []


def test_strategies_without_hypothesis_say_what_to_install(monkeypatch):
    monkeypatch.delitem(sys.modules, "vla_attention.testing.strategies", raising=False)
    monkeypatch.setitem(sys.modules, "hypothesis", None)
    with pytest.raises(MissingDependency, match="pip install hypothesis"):
        import vla_attention.testing.strategies  # noqa: F401
    monkeypatch.delitem(sys.modules, "vla_attention.testing.strategies", raising=False)
