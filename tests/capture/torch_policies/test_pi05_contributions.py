"""One checkpoint of pi0.5 through `vla-attention capture pi` and `va.layouts.pi0_pytorch`: the same contributions."""

from __future__ import annotations

import numpy as np
import torch

import vla_attention as va
from tests.capture.torch_policies.openpi_pi05 import PI05Pytorch
from tests.kit.policy_inputs import make_observation
from vla_attention.capture.policies.noise import initial_noise
from vla_attention.capture.policies.pi.embedded import dummy_policy
from vla_attention.capture.recording.recorder import make_recorders
from vla_attention.schemas.segments import segments_of
from vla_attention.schemas.stores.reader import open_store
from vla_attention.schemas.stores.store_format import Recording

SEED = 7


def by_span(gram: np.ndarray, spans: list[str]) -> np.ndarray:
    """Gram matrices (..., part, part) of the spans and the update, from those of parts, each of a span."""
    names = [*dict.fromkeys(spans), "update"]
    members = np.array([[float(name == of) for name in names] for of in [*spans, "update"]])
    return members.T @ gram @ members


def test_gates_are_in_both(tmp_path):
    policy = dummy_policy()
    config, given = policy.model.config, policy.prepare(make_observation(1), "put the red cube on the plate")
    steps = tuple(range(config.num_denoise_steps))
    recording = Recording((0, 1, 2), (0, 1, 2), steps, tuple(range(8)), "mean", 4, 10, contributions=True)
    recorder = make_recorders(recording, policy.sites, given.key_role)["joint"]
    policy.act(given, SEED, {"joint": recorder})
    captured = recorder.finish()
    segments = segments_of(policy.sites[0], given.key_role["joint"])

    model = PI05Pytorch(config)
    model.load_state_dict(policy.model.state_dict())
    arguments = {
        "images": {camera: given.tensors[f"image:{camera}"] for camera in config.cameras},
        "image_masks": {camera: given.tensors[f"image_mask:{camera}"] for camera in config.cameras},
        **{name: given.tensors[name] for name in ("tokens", "token_mask", "state")},
        "noise": torch.from_numpy(initial_noise(SEED, (1, config.action_horizon, config.action_dim))),
    }
    torch.testing.assert_close(
        model.sample_actions(**arguments), policy.model.sample_actions(**arguments), rtol=1e-4, atol=1e-5
    )
    layout = va.layouts.pi0_pytorch(model, num_steps=config.num_denoise_steps)
    assert layout.name == "pi05_pytorch"
    with (
        va.record(tmp_path / "a.zarr", model, layout=layout, denoise_steps="all", bits=23, durable=False) as run,
        run.episode(task_id=0, episode_index=0, instruction="put the red cube on the plate") as episode,
        episode.replan(env_step=0),
    ):
        model.sample_actions(**arguments)
    stored = open_store(tmp_path / "a.zarr").episodes[0]
    np.testing.assert_allclose(stored.read("joint/rows")[0], captured.rows, atol=2e-6)
    of_capture = by_span(captured.contribution, [segment.span for segment in segments])
    of_record = by_span(
        stored.read("joint/contribution")[0], [segment.span for segment in stored.attributes.segments["joint"]]
    )
    assert of_capture.shape == of_record.shape
    scale = of_capture[..., -1:, -1:]
    np.testing.assert_allclose(of_record / scale, of_capture / scale, atol=2e-4)
    gates = [
        block.input_layernorm(torch.zeros(1, 1, config.action_expert.width), torch.ones(1, config.action_expert.width))
        for block in model.paligemma_with_expert.gemma_expert.model.layers
    ]
    assert all((gate - 1).abs().max() > 0.3 for _, gate in gates)
