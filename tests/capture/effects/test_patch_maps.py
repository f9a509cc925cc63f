"""Maps of patches: their exact changes are those of reruns, and the rest of the store is as without them."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
import zarr

from tests.capture.effects.test_measurement import call_of, measurement
from tests.capture.effects.test_recorded_effects import adds_alone, damaged
from tests.capture.interventions.test_interventions_on_policies import policy_named
from tests.capture.rerun.conftest import capture
from tests.capture.rerun.conftest import pi_store as pi_store
from vla_attention.capture.__main__ import main
from vla_attention.capture.effects.patch_maps import DRAWN, STRONGEST
from vla_attention.capture.torch_policies.repeated_calls import effects_of_layout
from vla_attention.schemas.errors import BadArgument
from vla_attention.schemas.stores.reader import open_store
from vla_attention.schemas.stores.verify import verify_store


@pytest.fixture(scope="module")
def mapped(tmp_path_factory) -> Path:
    return capture(tmp_path_factory.mktemp("maps") / "pi.zarr", "pi", "--effects", "map")


def test_the_rest_of_the_store_is_as_without_a_map(pi_store, mapped):
    adds_alone(pi_store, mapped, {"effects/change", "joint/cut", "effects/map", "effects/patch_change"})


def test_the_strongest_patches_and_others_are_knocked_out(mapped):
    store = open_store(mapped)
    layout = store.attributes.sites[0]
    for episode in store.episodes:
        one, sizes = episode.attributes.effects.map, episode.read("effects/map")
        cameras = [camera.name for camera in store.attributes.policy.cameras]
        assert list(one.keys) == [key for camera in cameras for key in layout.patch_keys(camera)]
        assert list(one.replan) == list(range(episode.attributes.num_replans)) == list(range(len(sizes)))
        entries, number = np.array(one.patch).reshape(len(sizes), -1), round(STRONGEST * len(one.keys))
        drawn = np.array(one.drawn).reshape(entries.shape)
        assert entries.shape[1] == number + min(DRAWN, len(one.keys) - number)
        assert (drawn == (np.arange(entries.shape[1]) >= number)).all()
        for row, patches in zip(sizes, entries, strict=True):
            assert set(patches[:number]) == set(np.argsort(-row)[:number])
            assert len(set(patches)) == len(patches)
    first, second = (one.read("effects/map") for one in store.episodes[:2])
    assert not np.array_equal(first, second)


def test_a_change_without_a_patch_is_that_of_a_rerun(mapped, tmp_path):
    episode = open_store(mapped).episodes[0]
    effects, change = episode.attributes.effects, episode.read("effects/patch_change")
    for entry in (0, len(change) - 1):  # the strongest, and one that was drawn
        key, replan = effects.map.keys[effects.map.patch[entry]], effects.map.patch_replan[entry]
        target = tmp_path / f"{entry}.zarr"
        words = ["rerun", str(mapped), "--output", str(target), "--check", "0", "--num-episodes", "1", "--task", "0"]
        assert main([*words, "--knockout", f"keys:{key}-{key}", "--knockout-queries", "all"]) == 0
        rerun = open_store(target).episodes[0]
        expected = (rerun.read("actions") - rerun.read("base_actions"))[replan]
        np.testing.assert_allclose(change[entry] * np.array(effects.units), expected, atol=1e-5)
        assert np.abs(expected).max() > 1e-4


@pytest.mark.parametrize("kind", ["refused", "not finite", "without memory"])
def test_calls_whose_changes_cannot_be_used_have_an_order_alone(kind, monkeypatch):
    policy = policy_named("pi05")
    given, context, actions = call_of(policy)
    run = measurement(policy, items=("map",))
    make = type(policy).act_variants

    def spoiled(self, variants, num_steps, batch):
        if kind == "without memory":
            raise torch.OutOfMemoryError
        made = list(make(self, variants, num_steps, batch))
        for i, one in enumerate(made):
            if (kind == "refused" and i == 0) or (kind == "not finite" and i > 1):
                made[i] = one + (1.0 if kind == "refused" else np.nan)
        return made

    monkeypatch.setattr(type(policy), "act_variants", spoiled)
    effects = run.begin().measure(given, 11, actions, context)
    assert effects.map.patches == effects.map.drawn == ()
    assert effects.map.change.shape == (0, *actions.shape)
    assert (effects.map.sizes > 0).any()


def test_fewer_denoise_steps_have_no_map():
    with pytest.raises(BadArgument, match="--effects-steps"):
        measurement(policy_named("pi05"), items=("map",), denoise_steps=1)


def test_policies_without_a_backward_pass_have_none(tmp_path, capsys):
    with pytest.raises(AssertionError):
        capture(tmp_path / "cosmos.zarr", "cosmos", "--effects", "map")
    assert "--effects map" in capsys.readouterr().err
    with pytest.raises(BadArgument, match="map"):
        effects_of_layout("map", None)


def test_verify_finds_maps_that_do_not_fit(mapped, tmp_path):
    for name, edit in {
        "keys": lambda of: of["keys"].pop(),
        "patch": lambda of: of["patch"].append(0),
        "drawn": lambda of: of["drawn"].pop(),
        "replan": lambda of: of["replan"].pop(),
    }.items():
        copy = tmp_path / name
        shutil.copytree(mapped, copy)
        assert damaged(copy, lambda attributes, edit=edit: edit(attributes["effects"]["map"])), name


def test_a_size_below_zero_is_found(mapped, tmp_path):
    copy = tmp_path / "copy.zarr"
    shutil.copytree(mapped, copy)
    folder = sorted((copy / "episodes").iterdir())[0]
    array = zarr.open_group(folder, mode="r+")["effects/map"]
    values = array[:]
    values[0, 0] = -1.0
    array[:] = values
    faults = damaged(copy, lambda attributes: None)
    document = json.loads((folder / "zarr.json").read_text())
    assert document["attributes"]["effects"]["map"]
    assert any("effects/map" in fault for fault in map(str, [*faults, *verify_store(open_store(copy))]))
