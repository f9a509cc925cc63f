"""pi0.5 of LeRobot, in 0.4 with openpi's layers: one checkpoint, also through `vla-attention capture pi`."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import pytest
import torch

pytest.importorskip("lerobot", reason="run by make test-policies, in .venv-lerobot")

import vla_attention as va
from tests.policies.lerobot_pi_models import small_pi05_lerobot
from vla_attention.capture.policies.pi.config import GemmaConfig, PiConfig, SiglipConfig
from vla_attention.capture.policies.pi.model import PiModel, expected_shapes, model_from_state
from vla_attention.capture.recording.recorder import make_recorders
from vla_attention.schemas.layout import Role
from vla_attention.schemas.stores.reader import open_store
from vla_attention.schemas.stores.store_format import Recording

CONFIG = PiConfig(
    paligemma=GemmaConfig(width=32, depth=3, mlp_dim=48, head_dim=8),
    action_expert=GemmaConfig(width=24, depth=3, mlp_dim=32, head_dim=8),
    siglip=SiglipConfig(width=16, depth=1, mlp_dim=24, num_heads=2, image_size=28),
    vocab_size=40,
    action_horizon=4,
    max_token_len=9,
    num_denoise_steps=3,
    time_convention="stepped",
)
WORDS = 6


@pytest.fixture(scope="module")
def model() -> PiModel:
    generator = torch.Generator().manual_seed(0)
    state = {}
    for name, shape in expected_shapes(CONFIG).items():
        weight = torch.randn(shape, generator=generator)
        state[name] = weight * (int(np.prod(shape[1:])) ** -0.5 if len(shape) > 1 else 0.2)
    return model_from_state(CONFIG, state)


@pytest.fixture(scope="module")
def given() -> Mapping[str, torch.Tensor]:
    generator = torch.Generator().manual_seed(1)
    tokens = torch.arange(CONFIG.max_token_len)[None]
    return {
        "images": torch.rand(len(CONFIG.cameras), 1, 3, 28, 28, generator=generator) * 2 - 1,
        "tokens": tokens,
        "token_mask": tokens < WORDS,
        "noise": torch.randn(1, CONFIG.action_horizon, CONFIG.action_dim, generator=generator),
    }


def test_contributions_are_those_of_our_own_network(model, given, tmp_path):
    policy = small_pi05_lerobot(CONFIG, model.state_dict())
    layout = va.layouts.pi0_pytorch(policy, cameras=CONFIG.cameras)
    site = layout.site("joint").keys
    roles = dict.fromkeys(CONFIG.cameras, Role.IMAGE) | {"prompt": Role.INSTRUCTION, "actions": Role.ACTION}
    codes = np.concatenate([np.full(span.num_keys, roles[span.name], dtype=np.uint8) for span in site.spans])
    start = site.span("prompt").start
    codes[start + WORDS : site.span("prompt").stop] = Role.PADDING
    recording = Recording((0, 1, 2), (0, 1, 2), (0, 1, 2), tuple(range(8)), "mean", 4, 23, contributions=True)
    recorder = make_recorders(recording, (site,), {"joint": codes})["joint"]
    ours = model.sample_actions(
        images=dict(zip(CONFIG.cameras, given["images"], strict=True)),
        image_masks={camera: torch.ones(1, dtype=torch.bool) for camera in CONFIG.cameras},
        state=torch.zeros(1, CONFIG.action_dim),
        recorder=recorder,
        **{name: given[name] for name in ("tokens", "token_mask", "noise")},
    )
    expected = recorder.finish()
    masks = [torch.ones(1, dtype=torch.bool)] * len(CONFIG.cameras)
    with (
        va.record(tmp_path / "a.zarr", policy, layout=layout, denoise_steps="all", bits=23, durable=False) as run,
        run.episode(task_id=0, episode_index=0, instruction="") as episode,
        episode.replan(env_step=0),
        torch.no_grad(),
    ):
        theirs = policy.sample_actions(
            list(given["images"]), masks, given["tokens"], given["token_mask"], noise=given["noise"]
        )
    torch.testing.assert_close(theirs, ours, rtol=1e-4, atol=1e-5)
    stored = open_store(tmp_path / "a.zarr").episodes[0]
    np.testing.assert_allclose(stored.read("joint/rows")[0], expected.rows, atol=2e-6)
    assert expected.contribution is not None
    gram, scale = stored.read("joint/contribution")[0], expected.contribution[..., -1:, -1:]
    np.testing.assert_allclose(gram / scale, expected.contribution / scale, atol=2e-4)
