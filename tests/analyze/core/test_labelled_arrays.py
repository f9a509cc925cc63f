"""Labelled arrays hold what the raw Zarr arrays hold, each number at its own label."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import zarr

import vla_attention as va
from tests.kit.raw_rows import probabilities
from tests.kit.stores import StoreSpec, num_steps, write_store
from vla_attention.schemas.layout import Role

SPEC = StoreSpec(tasks=(0, 1), episodes=2, replans=3, mantissa_bits=23, coverage=False, frames=False)
#: Groups of the grouping 'default': the roles of their keys.
GROUPS = {
    "visual": (Role.IMAGE,),
    "linguistic": (Role.BOS, Role.TEMPLATE, Role.INSTRUCTION, Role.TEXT),
    "state": (Role.STATE,),
    "action": (Role.ACTION,),
}
#: First key of each camera, and the columns of its patches.
CAMERAS = {"base_0_rgb": (0, 4, 12), "left_wrist_0_rgb": (12, 2, 4), "right_wrist_0_rgb": (16, 2, 4)}


@pytest.fixture(scope="module")
def store(tmp_path_factory) -> Path:
    return write_store(tmp_path_factory.mktemp("labelled") / "a.zarr", spec=SPEC)


def raw(store: Path, task: int, episode: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rows (replan, layer, denoise, head, key), what uniform attention gives (replan, key), and roles."""
    group = zarr.open_group(store, mode="r")[f"episodes/task{task:03d}_episode{episode:03d}"]
    rows, roles = probabilities(group["joint/rows"]).astype(float)[..., 0, :], group["joint/key_role"][:]
    seen = ~np.isin(roles, [Role.PADDING, Role.MASKED_IMAGE])
    return rows, seen / seen.sum(axis=1, keepdims=True), roles


def test_masses_stand_at_their_labels(store):
    masses = va.open(store).to_xarray(denoise=[9], layers=[2])
    assert masses.sizes["sample"] == 2 * 2 * 3
    assert (masses["layer"].values.tolist(), masses["denoise"].values.tolist()) == ([2], [9])
    assert masses["denoise_time"].item() == pytest.approx(0.1)
    arrays = {(task, episode): raw(store, task, episode) for task in (0, 1) for episode in (0, 1)}
    for sample in range(masses.sizes["sample"]):
        one = masses.isel(sample=sample)
        task, episode, replan = (one[name].item() for name in ("task_id", "episode_index", "replan"))
        assert (task, episode, replan) == (sample // 6, sample // 3 % 2, sample % 3)
        assert (one["env_step"].item(), one["num_steps"].item()) == (10 + 5 * replan, num_steps(SPEC, episode))
        assert one["success"].item() == episode % 2
        rows, uniform, roles = arrays[task, episode]
        for name, members in GROUPS.items():
            keys = [key for key, role in enumerate(roles[replan]) if role in members]
            assert one["num_keys"].sel(group=name).item() == len(keys)
            assert one["uniform_mass"].sel(group=name).values == pytest.approx(uniform[replan, keys].sum(), rel=1e-5)
            of_heads = one["mass"].sel(layer=2, denoise=9, group=name).values
            assert of_heads == pytest.approx(rows[replan, 1, 1][:, keys].sum(axis=1), rel=1e-6)
        assert one["num_valid"].item() == (uniform[replan] > 0).sum()


def test_rows_stand_at_their_keys(store):
    found = list(va.open(store).to_xarray(rows=True, tasks=[1]))
    assert [one["episode_index"].values.tolist() for one in found] == [[0] * 3, [1] * 3]
    for episode, one in enumerate(found):
        rows, _, roles = raw(store, 1, episode)
        assert one["layer"].values.tolist() == [0, 2]
        np.testing.assert_allclose(one["rows"].values, rows, rtol=1e-6)
        np.testing.assert_array_equal(one["key_role"].values, roles)
        place = [(-1, -1)] * one.sizes["key"]
        for first, columns, count in CAMERAS.values():
            place[first : first + count] = [divmod(patch, columns) for patch in range(count)]
        assert list(zip(one["patch_row"].values, one["patch_column"].values, strict=True)) == place
        cameras = [name for name, (_, _, count) in CAMERAS.items() for _ in range(count)]
        assert one["key_camera"].values.tolist() == [*cameras, *[""] * 19]
        assert one["key_span"].values[20:].tolist() == ["prompt"] * 14 + ["actions"] * 5
