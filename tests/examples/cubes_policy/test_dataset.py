from __future__ import annotations

import shutil

import numpy as np
import pytest

from examples.cubes_policy.batches import Batches, heat_targets, position_targets
from examples.cubes_policy.dataset import (
    CONTROLS,
    UnusableDemonstrations,
    pictures_of,
    read_demonstrations,
    split_scenes,
    task_weights,
    usable_samples,
)
from examples.cubes_policy.network import small_config
from examples.cubes_policy.training import state_statistics
from tests.kit.made_up_demonstrations import INSTRUCTIONS
from vla_attention.capture.environments.cubes.scene import paste_mark
from vla_attention.schemas.errors import BadArgument


def make_batches(demonstrations, tokenizer, control="words", **options):
    samples = demonstrations.samples
    chosen, _ = split_scenes(samples)
    statistics = state_statistics(samples.state)
    options = {"batch_size": 16, "seed": 0, "jitter": True, **options}
    config = small_config(tokenizer.vocab_size)
    return Batches(samples, chosen, INSTRUCTIONS, tokenizer, config, statistics, control, **options)


def test_parts_are_read_in_order(demonstrations):
    samples = demonstrations.samples
    assert len(samples) == 12 * 5 * 8
    assert samples.pictures.shape == (480, 2, 64, 64, 3)
    np.testing.assert_array_equal(np.unique(samples.scene), np.arange(12))


def test_a_folder_without_demonstrations_or_with_a_damaged_part(folder, tmp_path):
    copy = shutil.copytree(folder, tmp_path / "copy")
    arrays = dict(np.load(copy / "part_0001.npz"))
    np.savez(copy / "part_0001.npz", **(arrays | {"state": arrays["state"][:, :7]}))
    with pytest.raises(UnusableDemonstrations, match=r"'state' of .*part_0001\.npz' .*\(240, 7\)"):
        read_demonstrations(copy)

    whole = (folder / "part_0001.npz").read_bytes()
    flipped = whole[:1000] + bytes([whole[1000] ^ 1]) + whole[1001:]
    for damaged in (whole[:-30], flipped):
        (copy / "part_0001.npz").write_bytes(damaged)
        with pytest.raises(UnusableDemonstrations, match=r"part_0001\.npz"):
            read_demonstrations(copy)


def test_scenes_are_held_out_whole(demonstrations):
    training, held_out = split_scenes(demonstrations.samples)
    scene = demonstrations.samples.scene
    assert len(training) + len(held_out) == len(scene)
    assert 1 <= len(np.unique(scene[held_out])) <= 3
    fewer = demonstrations.samples.take(np.flatnonzero(scene < 9))
    assert set(fewer.scene[split_scenes(fewer)[1]]) == set(scene[held_out])
    assert not set(scene[training]) & set(scene[held_out])
    with pytest.raises(BadArgument, match="1 scene"):
        split_scenes(demonstrations.samples.take(np.flatnonzero(scene == 0)))


def test_a_batch_depends_on_seed_and_step_only(demonstrations, tokenizer):
    first, again = make_batches(demonstrations, tokenizer), make_batches(demonstrations, tokenizer)
    again.draw(1)
    one, other = first.draw(7), again.draw(7)
    assert one.tokens.equal(other.tokens)
    assert one.noise.equal(other.noise)
    assert one.images["base_0_rgb"].equal(other.images["base_0_rgb"])
    assert not one.noise.equal(first.draw(8).noise)
    assert not one.noise.equal(make_batches(demonstrations, tokenizer, seed=1).draw(7).noise)


def test_prompts_of_a_batch_are_those_of_the_policy(demonstrations, tokenizer):
    samples = demonstrations.samples
    batch = make_batches(demonstrations, tokenizer, jitter=False, batch_size=4)
    drawn = np.array([3, 100, 250, 400])
    made = batch._batch(drawn, drawn, np.random.default_rng(0))
    statistics = state_statistics(samples.state)
    for row, sample in enumerate(drawn):
        expected = tokenizer.tokenize(
            INSTRUCTIONS[samples.task[sample]],
            max_token_len=32,
            state=statistics.normaliser("quantile").normalise(samples.state[sample].astype(np.float64)),
        )
        length = made.tokens.shape[1]
        np.testing.assert_array_equal(made.tokens[row], expected.ids[:length])
        np.testing.assert_array_equal(made.token_mask[row], expected.mask[:length])
        assert not expected.mask[length:].any()
        np.testing.assert_allclose(made.images["left_wrist_0_rgb"][row].numpy().transpose(1, 2, 0) * 127.5 + 127.5,
                                   samples.pictures[sample, 1], atol=1e-3)  # fmt: skip


def test_controls_change_pictures_and_prompts_as_they_say(demonstrations, tokenizer):
    samples, chosen, others = demonstrations.samples, np.array([0, 45, 90]), np.array([300, 310, 320])
    plain = samples.pictures[chosen]
    made = {name: pictures_of(samples, chosen, others, INSTRUCTIONS, name) for name in CONTROLS}
    np.testing.assert_array_equal(made["words"], plain)
    np.testing.assert_array_equal(made["no-wrist"][:, 0], plain[:, 0])
    np.testing.assert_array_equal(made["no-wrist"][:, 1], samples.pictures[others, 1])
    np.testing.assert_array_equal(made["redundant"], made["mark"])
    np.testing.assert_array_equal(made["mark"][:, 1], plain[:, 1])
    task = samples.task[45]
    np.testing.assert_array_equal(made["mark"][1, 0], paste_mark(plain[1, 0], int(samples.target[45]), int(task)))
    assert not usable_samples(samples, "mark", 23)[samples.destination >= 0].any()
    assert usable_samples(samples, "redundant", 23).all()
    assert (samples.task[usable_samples(samples, "words", 2)] < 2).all()

    def different_prompts(control):
        samples_of = make_batches(demonstrations, tokenizer, control, jitter=False)
        return len({tuple(row[:8].tolist()) for row in samples_of.draw(0).tokens})

    assert different_prompts("mark") == 1
    assert different_prompts("redundant") > 1


def test_heat_is_around_the_cube_and_absent_where_it_is_not_seen():
    pixels = np.full((2, 1, 4, 2), np.nan, dtype=np.float32)
    pixels[0, 0, 1] = (0.5 / 8, 7.5 / 8)  # the centre of the last patch of the first row
    heat, exists = heat_targets(pixels, np.array([1, 1]), np.array([-1, 2]), grid=8)
    assert exists.tolist() == [[[True, False]], [[False, False]]]
    assert heat[0, 0, 0].argmax() == 7
    np.testing.assert_allclose(heat.sum(axis=-1), 1.0, atol=1e-6)


def test_positions_are_relative_and_absolute():
    cubes = np.arange(12, dtype=np.float32).reshape(1, 4, 3)
    positions, exists = position_targets(cubes, np.ones((1, 3), np.float32), np.array([2]), np.array([-1]))
    np.testing.assert_allclose(positions[0, 0], np.array([5, 6, 7]) * 10)
    np.testing.assert_allclose(positions[0, 1], np.array([6, 7, 8]) * 10)
    assert exists[0].tolist() == [True, True, False, False]


def test_tasks_are_weighted_by_the_root_of_their_share():
    weights = task_weights(np.array([0, 1, 1, 1, 1]))
    np.testing.assert_allclose(weights.sum(), 1.0)
    np.testing.assert_allclose(weights[1:].sum() / weights[0], 2.0)
