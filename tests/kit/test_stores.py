"""The made-up stores: what it says a store holds is what plain Zarr finds."""

from __future__ import annotations

import numpy as np
import pytest
import zarr

from tests.kit import stores as kit
from tests.kit.raw_rows import probabilities
from tests.kit.tokens import libero_tokens
from vla_attention.schemas.stores.store_format import NUMBERS


@pytest.mark.parametrize(
    "spec",
    [
        kit.StoreSpec(),
        kit.StoreSpec(mantissa_bits=23, queries="all", frames=False, coverage=False, tasks=(4,), episodes=1),
        kit.StoreSpec(tokens=libero_tokens(2), layers=(1,), heads=(0,), tasks=(0,), episodes=1),
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
            found = probabilities(group[name]) if name == "joint/rows" else group[name][:]
            assert found.dtype == values.dtype, name
            np.testing.assert_allclose(found, values, rtol=2e-7 if name == "joint/atoms" else 0, err_msg=name)
