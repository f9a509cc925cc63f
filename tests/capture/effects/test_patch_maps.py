"""Maps of patches: their exact changes are those of reruns, and the rest of the store is as without them."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import zarr

from tests.capture.effects.test_measurement import by_hand, call_of, measurement
from tests.capture.effects.test_recorded_effects import adds_alone, damaged
from tests.capture.interventions.test_interventions_on_policies import policy_named
from tests.capture.rerun.conftest import capture
from tests.capture.rerun.conftest import pi_store as pi_store
from vla_attention.capture.__main__ import main
from vla_attention.capture.effects.arguments import EffectSettings
from vla_attention.capture.effects.patch_maps import DRAWN, STRONGEST, without_block
from vla_attention.capture.torch_policies.repeated_calls import effects_of_layout
from vla_attention.schemas.effects import MapBlocks
from vla_attention.schemas.errors import BadArgument
from vla_attention.schemas.interventions import Interventions, KeyKnockout
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


@pytest.mark.parametrize("items", ["map", "map:2x2"])
def test_fewer_denoise_steps_and_other_readers_have_no_map(items):
    with pytest.raises(BadArgument, match="--effects-steps"):
        measurement(policy_named("pi05"), items=(items,), denoise_steps=1)
    with pytest.raises(BadArgument, match="readers"):
        measurement(policy_named("pi05"), items=(items,), readers=("pictures", *(["action"] if items == "map" else [])))


def test_a_map_of_blocks_without_a_call_is_none(monkeypatch):
    policy = policy_named("pi05")
    given, context, actions = call_of(policy)
    run = measurement(policy, items=("map:2x2",))
    monkeypatch.setattr(run, "actions_of", lambda variants: {})
    assert run.begin().measure(given, 11, actions, context).map is None


def test_a_store_names_blocks_once_where_all_replans_have_the_same(tmp_path):
    store = open_store(capture(tmp_path / "pi.zarr", "pi", "--effects", "map:2x2"))
    for episode in store.episodes:
        one = episode.attributes.effects.map
        assert (one.patch, one.patch_replan, one.drawn) == (tuple(range(one.num_blocks)), (), ())
        assert len(one.entries) == len(episode.read("effects/patch_change")) == len(one.replan) * one.num_blocks
        sizes = np.sqrt((episode.read("effects/patch_change")[:, : one.steps].astype(float) ** 2).mean(axis=(1, 2)))
        np.testing.assert_allclose(episode.read("effects/map").ravel(), sizes, rtol=1e-5)


def test_policies_without_a_backward_pass_have_blocks_only(tmp_path, capsys):
    with pytest.raises(AssertionError):
        capture(tmp_path / "cosmos.zarr", "cosmos", "--effects", "map")
    assert "map:4x4" in capsys.readouterr().err
    for form in ("map", "map:picture:2x2"):
        with pytest.raises(BadArgument, match="map:8x8"):
            effects_of_layout(form, None)


@pytest.mark.parametrize("name", ["pi05", "pi0", "cosmos"])
def test_a_block_is_hidden_as_a_knockout_of_its_patches_hides_it(name):
    policy = policy_named(name)
    given, context, actions = call_of(policy)
    run = measurement(policy, ("map:2x2",))
    one = run.begin().measure(given, 11, actions, context).map
    assert len(run.lines) == 1
    of_block = {}
    for key, block in zip(one.form.keys, one.form.blocks, strict=True):
        of_block.setdefault(block, []).append(key)
    assert one.patches == tuple(sorted(of_block))
    assert one.form.num_blocks == 4 * len(policy.cameras) == len(one.sizes)
    site = next(site for site in policy.sites if site.name == one.form.site)
    middle = site.patch_keys(policy.cameras[0].name)
    side = round(len(middle) ** 0.5)
    assert of_block[1] == middle.reshape(side, side)[: side // 2, side // 2 :].ravel().tolist()
    for place, change in zip(one.patches, one.change, strict=True):
        selector = " | ".join(f"keys:{key}-{key}" for key in of_block[place])
        condition = Interventions(keys=(KeyKnockout(selector, queries="all"),))
        expected = by_hand(policy, condition, given, context) - actions
        np.testing.assert_allclose(change * run.units, expected, atol=1e-5)
        steps = change[: one.form.steps].astype(float)
        assert one.sizes[place] == pytest.approx(np.sqrt((steps**2).mean()), rel=1e-5)
    assert np.abs(one.change).max() > 1e-4
    assert not any(one.drawn)


@pytest.mark.parametrize("name", ["pi05", "cosmos"])
def test_a_block_of_the_picture_is_filled_from_around(name):
    policy = policy_named(name)
    given, context, actions = call_of(policy)
    run = measurement(policy, ("map:picture:2x1",))
    one = run.begin().measure(given, 11, actions, context).map
    assert (one.form.way, one.form.reader) == ("picture", "")
    camera = policy.cameras[0].name
    picture = given.given.frames[camera]
    changed = without_block(picture, (1, 0), MapBlocks("picture", 2, 1))
    rows, columns = (np.flatnonzero((changed != picture).any(axis=axes)) for axes in ((1, 2), (0, 2)))
    height, width = picture.shape[:2]
    assert (rows[0], rows[-1], columns[0], columns[-1]) == (height // 2, height - 1, 0, width - 1)
    assert changed.min() >= picture.min()
    frames = {**given.given.frames, camera: changed}
    own = {name: one for name, one in given.given.camera_frames.items() if name != camera}
    again = policy.prepare_again(replace(given.given, frames=frames, camera_frames=own))
    expected = policy.act(again, 11) - actions
    np.testing.assert_allclose(one.change[one.patches.index(1)] * run.units, expected, atol=1e-5)
    assert np.abs(expected).max() > 1e-5


def test_blocks_smaller_than_patches_are_the_patches():
    policy = policy_named("pi05")
    given, context, actions = call_of(policy)
    one = measurement(policy, ("map:50x50",)).begin().measure(given, 11, actions, context).map
    assert sorted(one.form.blocks) == list(range(len(one.form.keys)))


def test_blocks_of_a_picture_without_a_patch_are_refused():
    with pytest.raises(BadArgument, match="50 x 50"):
        measurement(policy_named("pi05"), ("map:picture:50x50",))


@pytest.mark.parametrize("words", ["map:1x1", "map:0x4", "map:8", "map,map:4x4", "map:picture"])
def test_maps_that_are_none_are_refused(words):
    with pytest.raises(BadArgument):
        EffectSettings(tuple(words.split(",")))


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
