"""A camera's picture exchanged for the mean of its task's: by hand from the stored pictures, and what is refused."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import zarr

from tests.capture.rerun.conftest import pi_store as pi_store
from vla_attention.capture.__main__ import main
from vla_attention.capture.effects.arguments import EffectSettings
from vla_attention.capture.effects.mean_pictures import pictures_of
from vla_attention.capture.policies.pi.embedded import dummy_policy
from vla_attention.capture.rerun.stored_calls import read_calls
from vla_attention.schemas.stores.reader import open_store

SETTINGS = EffectSettings(("cameras",))


def mean_by_hand(path, task: int, camera: str) -> np.ndarray:
    """Episodes of the store have fewer replans than are looked at: the mean is over all of them."""
    episodes = zarr.open_group(path, mode="r")["episodes"]
    means = [group[f"frames/{camera}"][:].astype(float).mean(axis=0) for name, group in episodes.groups()
             if name.startswith(f"task{task:03d}")]  # fmt: skip
    assert len(means) > 1
    return np.rint(np.mean(means, axis=0)).astype(np.uint8)


def test_the_mean_is_that_of_the_tasks_stored_pictures(pi_store):
    store, policy = open_store(pi_store), dummy_policy()
    pictures = pictures_of(SETTINGS, policy, store.suite, store)
    for task in (0, 1):
        known = pictures.of_task(task)
        assert set(known) == {"base_0_rgb", "left_wrist_0_rgb"}
        for camera, mean in known.items():
            np.testing.assert_array_equal(mean, mean_by_hand(pi_store, task, camera))
    assert pictures.of_task(7) == {}


def test_a_rerun_measures_what_the_policy_does_with_it(pi_store, tmp_path):
    target, policy = tmp_path / "effects.zarr", dummy_policy()
    assert main(["rerun", str(pi_store), "--check", "0", "--output", str(target), "--effects", "cameras"]) == 0
    for episode in open_store(target).episodes:
        effects, calls = episode.attributes.effects, read_calls(episode)
        names = [condition.name for condition in effects.conditions]
        assert "base_0_rgb_blank" not in names
        entries = np.flatnonzero(np.array(effects.condition) == names.index("base_0_rgb_mean"))
        mean = mean_by_hand(pi_store, episode.attributes.task_id, "base_0_rgb")
        for entry in entries:
            replan = effects.replan[entry]
            given = calls.given(replan)
            changed = policy.prepare_again(
                replace(given, frames={**given.frames, "base_0_rgb": mean}, camera_frames={})
            )
            expected = policy.act(changed, int(calls.noise_seed[replan])) - calls.actions[replan]
            found = episode.read("effects/change")[entry] * np.array(effects.units)
            np.testing.assert_allclose(found, expected, atol=1e-5)
