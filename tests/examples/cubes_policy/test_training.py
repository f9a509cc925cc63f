from __future__ import annotations

import csv
import json

import numpy as np
import pytest
import torch

from examples.cubes_policy.batches import number_ids
from examples.cubes_policy.export import export
from examples.cubes_policy.network import CAMERAS, initial_model, small_config
from examples.cubes_policy.objectives import Heads, losses
from examples.cubes_policy.training import (
    TrainingSettings,
    UnusableTraining,
    learning_rate,
    train,
)
from examples.cubes_policy.training_pass import encode, velocities
from tests.examples.cubes_policy.test_dataset import make_batches
from tests.kit.made_up_demonstrations import INSTRUCTIONS
from tests.thorough.hostile_checkpoints.hostile_files import TRACE, executing_pickle, pipe, torch_zip
from vla_attention.capture.policies.pi.family import PiSettings
from vla_attention.capture.policies.pi.flow_time import denoise_times
from vla_attention.capture.policies.pi.loading import build_pi_policy
from vla_attention.schemas.errors import BadArgument

SETTINGS = TrainingSettings(steps=8, batch_size=4, log_every=2, evaluate_every=4)


def quiet(line: str) -> None:
    """Say nothing."""


@pytest.fixture(scope="module")
def whole(demonstrations, tmp_path_factory):
    folder = tmp_path_factory.mktemp("whole")
    return train(demonstrations, INSTRUCTIONS, folder, SETTINGS, say=quiet), folder


@pytest.fixture(scope="module")
def model(tokenizer):
    return initial_model(small_config(tokenizer.vocab_size), number_ids(tokenizer).tolist(), 0)


def test_the_training_pass_is_the_pass_of_inference(model, demonstrations, tokenizer):
    batch = make_batches(demonstrations, tokenizer, batch_size=3).draw(0)
    with torch.no_grad():
        prefix = encode(model, batch)
        x = batch.noise[:, 0]
        for time in denoise_times(2):
            velocity = velocities(model, prefix, x[:, None], torch.full((3, 1), float(time)))
            x = x - velocity[:, 0] / 2
    expected = model.sample_actions(
        images=batch.images,
        image_masks={camera: torch.ones(3, dtype=torch.bool) for camera in CAMERAS},
        tokens=batch.tokens,
        token_mask=batch.token_mask,
        state=torch.zeros(3, 8),
        noise=batch.noise[:, 0],
        num_steps=2,
    )
    torch.testing.assert_close(x, expected, atol=1e-5, rtol=1e-5)


def test_pairs_do_not_see_each_other(model, demonstrations, tokenizer):
    batch = make_batches(demonstrations, tokenizer, batch_size=2).draw(0)
    with torch.no_grad():
        prefix = encode(model, batch)
        together = velocities(model, prefix, batch.noise, batch.times)
        alone = velocities(model, prefix, batch.noise[:, 2:3], batch.times[:, 2:3])
    torch.testing.assert_close(together[:, 2:3], alone, atol=1e-5, rtol=1e-5)


def test_every_part_of_the_model_gets_a_gradient(model, demonstrations, tokenizer):
    heads = Heads(128, 0)
    parts = losses(model, heads, make_batches(demonstrations, tokenizer, batch_size=4).draw(0))
    sum(parts.values()).backward()
    # The last block of the language model only gives keys and values.
    last = "language_model.layers.3."
    unused = (".q_proj", ".o_proj", ".mlp.", "post_attention_layernorm")
    for name, parameter in model.named_parameters():
        idle = "language_model.norm" in name or (last in name and any(part in name for part in unused))
        assert (parameter.grad is None) == idle, name
    model.zero_grad()


@pytest.mark.thorough
def test_the_loss_falls(demonstrations, tmp_path):
    settings = TrainingSettings(steps=40, batch_size=8, log_every=10, evaluate_every=40)
    train(demonstrations, INSTRUCTIONS, tmp_path, settings, say=quiet)
    with (tmp_path / "log.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [int(row["step"]) for row in rows] == [10, 20, 30, 40]
    assert float(rows[-1]["train_flow"]) < 0.6 * float(rows[0]["train_flow"])
    assert float(rows[-1]["held_out_total"]) > 0


@pytest.mark.thorough
def test_a_training_that_was_stopped_goes_on_the_same(demonstrations, whole, tmp_path):
    expected, folder = whole
    said: list[str] = []
    train(demonstrations, INSTRUCTIONS, tmp_path, SETTINGS, stop_at=3, say=said.append)
    assert f" step {SETTINGS.steps}" in said[0]
    found = train(demonstrations, INSTRUCTIONS, tmp_path, SETTINGS, resume=True, say=quiet)
    for name, tensor in expected.average.state_dict().items():
        torch.testing.assert_close(found.average.state_dict()[name], tensor, rtol=0, atol=1e-6)
    with (folder / "log.csv").open() as one, (tmp_path / "log.csv").open() as other:
        last_of_one, last_of_other = list(csv.DictReader(one))[-1], list(csv.DictReader(other))[-1]
    assert last_of_one["held_out_total"] == last_of_other["held_out_total"]


def test_a_folder_in_use_and_other_settings_are_refused(demonstrations, whole):
    _, folder = whole
    with pytest.raises(BadArgument):
        train(demonstrations, INSTRUCTIONS, folder, SETTINGS, say=quiet)
    other = TrainingSettings(steps=8, batch_size=4, seed=1)
    with pytest.raises(UnusableTraining, match=r"seed .*0"):
        train(demonstrations, INSTRUCTIONS, folder, other, resume=True, say=quiet)


def test_a_checkpoint_that_executes_or_is_damaged_is_refused(tmp_path):
    for content, named in (
        (executing_pickle(tmp_path), r"posix\.system"),
        (b"\x80\x02}.", r"checkpoint\.pt"),
        (b"\x80", r"checkpoint\.pt"),
    ):
        torch_zip(tmp_path / "checkpoint.pt", content)
        with pytest.raises(UnusableTraining, match=named):
            export(tmp_path, tmp_path / "out", "name")
    pipe(tmp_path / "checkpoint.pt")
    with pytest.raises(UnusableTraining, match=r"checkpoint\.pt|FIFO"):
        export(tmp_path, tmp_path / "out", "name")
    assert not (tmp_path / TRACE).exists()
    assert not (tmp_path / "out").exists()


def test_the_rate_warms_up_and_falls():
    rates = [learning_rate(step, 1000) for step in range(1000)]
    assert rates[0] == pytest.approx(2e-5)
    assert max(rates) == pytest.approx(1e-3)
    assert rates[-1] == pytest.approx(3e-5, rel=0.01)
    assert np.all(np.diff(rates[60:]) < 0)


def test_an_exported_policy_runs_like_any_checkpoint(demonstrations, whole, tmp_path):
    training, folder = whole
    card = export(folder, tmp_path / "mark_0", "my_policy")
    assert card["steps"] == 8
    policy = build_pi_policy(PiSettings(str(tmp_path / "mark_0")), "cpu")
    assert policy.name == "my_policy"
    assert not policy.identity().untrained
    assert policy.model.config == small_config(policy.tokenizer.vocab_size)
    for name, tensor in policy.model.state_dict().items():
        torch.testing.assert_close(
            tensor, training.average.state_dict()[name].to(torch.bfloat16).float(), rtol=0, atol=0
        )
    sample = demonstrations.samples.state[5].astype(np.float64)
    facts = json.loads((folder / "settings.json").read_text())["state"]
    low, high = np.array(facts["q01"]), np.array(facts["q99"])
    np.testing.assert_allclose(
        policy.processing.state.normalise(sample), (sample - low) / (high - low) * 2 - 1, rtol=1e-4
    )
    actions = np.random.default_rng(0).uniform(-1, 1, (10, 8))
    np.testing.assert_allclose(policy.processing.environment_actions(actions, sample), actions[:, :7], atol=1e-6)
    with pytest.raises(BadArgument, match="mark_0"):
        export(folder, tmp_path / "mark_0", "again")
