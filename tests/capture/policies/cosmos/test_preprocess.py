"""Pictures, ranges, and the image encoder's shortcuts."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from vla_attention.capture.policies.cosmos.config import VaeConfig
from vla_attention.capture.policies.cosmos.embedded import BUILTIN_RANGES, random_vae_weights
from vla_attention.capture.policies.cosmos.preprocess import (
    crop_and_enlarge,
    crop_size,
    pixels,
    upright,
)


def test_only_rows_are_reversed():
    picture = np.arange(2 * 3 * 3, dtype=np.uint8).reshape(2, 3, 3)
    assert np.array_equal(upright(picture), picture[::-1])


def test_the_middle_is_cut_out_and_enlarged():
    assert crop_size(224) == 212
    picture = np.zeros((224, 224, 3), dtype=np.uint8)
    picture[:6] = picture[-6:] = 255
    assert crop_and_enlarge(picture).max() == 0
    picture[6] = 255
    enlarged = crop_and_enlarge(picture)
    assert enlarged[0].min() > 200
    assert enlarged[3:].max() == 0


def test_ranges_are_applied_and_undone():
    statistics = BUILTIN_RANGES
    assert statistics.normalise_proprio(statistics.proprio_min).tolist() == [-1.0] * 9
    assert statistics.normalise_proprio(statistics.proprio_max).tolist() == [1.0] * 9
    beyond = statistics.environment_actions(np.full((2, 7), 1.5))
    assert (beyond > statistics.actions_max).all()  # not cut


SMALL_VAE = VaeConfig(base_dim=4)


@pytest.fixture(scope="module")
def state():
    pytest.importorskip("diffusers")
    return random_vae_weights(SMALL_VAE, seed=0)


def test_thirteen_frames_give_what_all_thirty_three_do(state):
    from diffusers import AutoencoderKLWan

    from vla_attention.capture.policies.cosmos.vae import build_encoder, vae_names

    names = vae_names(SMALL_VAE)
    whole = AutoencoderKLWan(base_dim=4)
    whole.load_state_dict({names[name][0]: tensor for name, tensor in state.items()})
    rng = np.random.default_rng(0)
    shown = [
        pixels(rng.integers(0, 255, (32, 32, 3), dtype=np.uint8), torch.float32, torch.device("cpu")) for _ in range(4)
    ]
    black = torch.full((1, 3, 1, 32, 32), -1.0)
    copies = [1, 4, 4, 4, 8, 12]
    video = torch.cat(
        [frame.expand(-1, -1, n, -1, -1) for frame, n in zip([black, black, *shown], copies, strict=True)], dim=2
    )
    assert video.shape[2] == 33
    with torch.no_grad():
        posterior = whole.encode(video).latent_dist.mean
    mean = torch.tensor(whole.config.latents_mean).view(1, -1, 1, 1, 1)
    std = torch.tensor(whole.config.latents_std).view(1, -1, 1, 1, 1)
    encoder = build_encoder(SMALL_VAE, state)
    first = encoder.encode(shown[:2])
    assert first.shape == (1, 16, 4, 4, 4)
    torch.testing.assert_close(first, ((posterior - mean) / std)[:, :, :4], rtol=1e-4, atol=1e-5)
    # The state of the convolutions after the black frames is kept, and later pictures do not change it.
    assert torch.equal(encoder.encode(shown[2:])[:, :, :2], first[:, :, :2])
    assert torch.equal(encoder.encode(shown[:2]), first)


def test_the_picture_before_shows_in_the_next_latent(state):
    from vla_attention.capture.policies.cosmos.vae import build_encoder

    encoder = build_encoder(SMALL_VAE, state)
    one, two, other = (torch.full((1, 3, 1, 32, 32), level) for level in (0.1, -0.4, 0.9))
    assert not torch.equal(encoder.encode([one, two])[:, :, 3], encoder.encode([other, two])[:, :, 3])
    assert torch.equal(encoder.encode([one, two])[:, :, 2], encoder.encode([one, other])[:, :, 2])
