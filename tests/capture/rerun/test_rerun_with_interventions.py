"""Stored policy calls with interventions: what is stored, that it is applied again to the bit, and what is refused."""

from __future__ import annotations

import json
import re

import numpy as np
import pytest

from tests.capture.rerun.test_rerun import refused
from vla_attention.capture.__main__ import main
from vla_attention.capture.policies.cosmos.family import CosmosSettings
from vla_attention.schemas.errors import BadArgument
from vla_attention.schemas.interventions import KeyKnockout, NoiseChange
from vla_attention.schemas.layout import Role
from vla_attention.schemas.stores.reader import Store, open_store
from vla_attention.schemas.stores.verify import verify_store

ONE = ("--task-id", "0", "--num-episodes", "1")


def rerun(base, target, *words: str) -> Store:
    assert main(["rerun", str(base), "--output", str(target), "--check", "0", *ONE, *words]) == 0
    store = open_store(target)
    assert verify_store(store) == []
    return store


def assert_applied_again(target, capsys) -> None:
    """An unchanged rerun of a store with interventions makes them again, to the bit."""
    capsys.readouterr()
    again = target.with_name("again.zarr")
    assert main(["rerun", str(target), "--output", str(again)]) == 0
    assert ": bit-equal" in capsys.readouterr().out
    assert open_store(again).attributes.interventions == open_store(target).attributes.interventions
    for old, new in zip(open_store(target).episodes, open_store(again).episodes, strict=True):
        arrays, again = ({**one.attributes.arrays} for one in (old, new))
        # The base of each is another one.
        assert again.pop("base_actions") == arrays["actions"] != arrays.pop("base_actions")
        assert arrays == again


def test_a_knockout_is_exact_stored_and_applied_again(pi_store, tmp_path, capsys):
    target = tmp_path / "without.zarr"
    store = rerun(pi_store, target, "--knockout", "camera:base_0_rgb", "--knockout-layers", "0", "1")
    knockout = KeyKnockout("camera:base_0_rgb", queries="all", layers=(0, 1))
    assert store.attributes.interventions.keys == (knockout,)
    assert store.attributes.interventions.name == "without_camera_base_0_rgb_queries_all_layers_0_1"
    assert store.attributes.rerun_of.run == open_store(pi_store).run
    [old], [new] = open_store(pi_store).episodes[:1], store.episodes
    (span,) = store.attributes.sites[0].camera_spans("base_0_rgb")
    before, after = (episode.read("joint/rows")[..., span.start : span.stop] for episode in (old, new))
    assert (before > 0).all()
    assert (after[:, :2] == 0).all()
    assert (after[:, 2:] > 0).all()
    np.testing.assert_array_equal(old.read("env_step"), new.read("env_step"))
    np.testing.assert_array_equal(old.read("noise_seed"), new.read("noise_seed"))
    assert (old.read("actions") != new.read("actions")).any()
    assert_applied_again(target, capsys)
    assert "interventions" in refused(capsys, "rerun", target, "--prompt", "empty")


def test_a_knockout_of_keys_without_mass_changes_nothing(pi_store, tmp_path):
    masked = ("--knockout", "camera:right_wrist_0_rgb | role:padding", "--allow-empty")
    store = rerun(pi_store, tmp_path / "nothing.zarr", *masked)
    [old], [new] = open_store(pi_store).episodes[:1], store.episodes
    np.testing.assert_array_equal(old.read("actions"), new.read("actions"))
    np.testing.assert_array_equal(old.read("joint/rows"), new.read("joint/rows"))


def test_prompt_picture_and_noise_are_those_that_the_model_saw(pi_store, tmp_path, capsys):
    target = tmp_path / "other.zarr"
    changes = ["--prompt", "empty", "--image", "base_0_rgb=blank", "--noise-seed", "99", "--name", "blind"]
    store = rerun(pi_store, target, *changes)
    [old], [new] = open_store(pi_store).episodes[:1], store.episodes
    assert store.attributes.interventions.name == "blind"
    assert store.attributes.interventions.noise == NoiseChange(99)
    assert (new.read("frames/base_0_rgb") == 128).all()
    np.testing.assert_array_equal(new.read("frames/left_wrist_0_rgb"), old.read("frames/left_wrist_0_rgb"))
    assert {prompt.instruction_text for prompt in new.attributes.prompts} == {""}
    assert not (new.read("joint/key_role") == Role.INSTRUCTION).any()
    assert not np.isin(new.read("noise_seed"), old.read("noise_seed")).any()
    assert len(set(new.attributes.noise_seed)) == new.attributes.num_replans == 3
    assert new.attributes.instruction == old.attributes.instruction
    assert_applied_again(target, capsys)


def test_prompts_of_another_task_shuffled_and_with_synonyms(pi_store, tmp_path):
    (tmp_path / "words.json").write_text(json.dumps({"red": "crimson"}))

    def prompt_of(change: str) -> set[str]:
        words = ["rerun", str(pi_store), "--output", str(tmp_path / "prompt.zarr"), "--overwrite", "--check", "0"]
        assert main([*words, "--num-episodes", "1", "--layers", "0", "--prompt", change]) == 0
        first = open_store(tmp_path / "prompt.zarr").episodes[0]
        return {prompt.instruction_text for prompt in first.attributes.prompts}

    assert prompt_of("task:1") == {"stack the red cube on top of the green cube"}
    assert prompt_of(f"synonyms:{tmp_path / 'words.json'}") == {"lift the crimson cube"}
    [order] = prompt_of("shuffled")
    assert sorted(order.split()) == ["cube", "lift", "red", "the"]


def test_a_changed_prompt_is_known_before_the_model_is_loaded(cosmos_store, monkeypatch, capsys):
    """Cosmos refuses a sentence without an embedding before it loads its weights, if it is told of it."""

    def build(settings, device):
        raise BadArgument(f"told: {settings.instructions}")

    monkeypatch.setattr(CosmosSettings, "build", build)
    said = refused(capsys, "rerun", cosmos_store, "--prompt", "text:fly to the moon")
    stored = ("lift the red cube", "fly to the moon", "stack the red cube on top of the green cube")
    assert f"told: {stored}" in said


@pytest.mark.thorough
def test_cosmos_without_words_and_with_the_wrist_alone(cosmos_store, tmp_path, capsys):
    target = tmp_path / "without.zarr"
    store = rerun(cosmos_store, target, "--knockout", "word:cube", "--keep", "frame:wrist")
    [episode] = store.episodes
    tokens = episode.tokens(store.attributes, "cross")
    keys = [key for word in tokens.words[0] if word.text == "cube" for key in word.keys]
    assert keys
    assert (episode.read("cross/rows")[..., keys] == 0).all()
    blank = store.attributes.sites[0].frame("frame0")
    assert (episode.read("self/rows")[..., blank.start : blank.stop] == 0).all()
    assert_applied_again(target, capsys)


def test_wrong_interventions_are_named_and_leave_no_store(pi_store, cosmos_store, tmp_path, capsys):
    target = tmp_path / "wrong.zarr"

    def said(*words: str, base=pi_store) -> str:
        sentence = refused(capsys, "rerun", base, "--output", target, "--check", "0", *words)
        assert not target.exists()
        return sentence

    assert re.search("'word:green' .*6 of 12", said("--knockout", "word:green"))
    assert "'base'" in said("--knockout", "camera:base")
    assert "'base'" in said("--image", "base=masked:cube")
    assert re.search("'base_0_rgb' .*12 of 12", said("--image", "base_0_rgb=masked:cube"))

    assert "query" in said("--knockout", "*")
    assert "5" in said("--prompt", "task:5")
    assert "8" in said("--knockout", "role:image", "--knockout-heads", "8")
    masked = "'camera:right_wrist_0_rgb' .*12 of 12"
    assert re.search(masked, said("--keep", "camera:right_wrist_0_rgb"))
    assert "prefix" in said("--knockout", "role:instruction", "--knockout-queries", "prefix", base=cosmos_store)


def test_the_prompt_of_a_task_that_is_not_run_again_is_known(pi_store, tmp_path):
    target = tmp_path / "other.zarr"
    words = ("--prompt", "task:1", "--task-id", "0", "--num-episodes", "1", "--check", "0")
    assert main(["rerun", str(pi_store), *words, "--output", str(target)]) == 0
    (episode,) = open_store(target).episodes
    base = {episode.attributes.task_id: episode.attributes.instruction for episode in open_store(pi_store).episodes}
    assert episode.attributes.task_id == 0
    assert base[0] != base[1]
    prompts = episode.tokens(open_store(target).attributes, "joint").prompts
    assert all(base[1] in prompt.text and base[0] not in prompt.text for prompt in prompts)
