"""The transformer: names and shapes of the published checkpoint, text as a null sink, rotary buffers, precision."""

from __future__ import annotations

import gzip
import json

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.kit.cosmos_helpers import GOLDEN
from tests.kit.cosmos_parity import EverythingObserver
from tests.kit.examples import examples
from vla_attention.capture.policies.cosmos.config import DitConfig, VaeConfig
from vla_attention.capture.policies.cosmos.dit import Dit, rotate
from vla_attention.capture.policies.cosmos.dit_weights import build_dit, dit_tensors, infer_dit_config
from vla_attention.capture.policies.cosmos.embedded import DUMMY_CONFIG, random_dit_weights
from vla_attention.capture.policies.cosmos.vae import expected_vae_shapes, infer_vae_config


@pytest.fixture(scope="module")
def manifest():
    with gzip.open(GOLDEN / "key_manifest_2b.json.gz") as file:
        return json.load(file)


@pytest.fixture(scope="module")
def weights():
    return random_dit_weights(DUMMY_CONFIG.dit, seed=1)


@pytest.fixture(scope="module")
def dit(weights):
    return build_dit(DUMMY_CONFIG.dit, weights)


def make_inputs(frames=5, height=4, width=6, batch=1, seed=0):
    draw = torch.Generator().manual_seed(seed)
    text = torch.zeros(batch, 10, DUMMY_CONFIG.dit.text_dim)
    text[:, :3] = torch.randn(batch, 3, DUMMY_CONFIG.dit.text_dim, generator=draw)
    mask = torch.zeros(batch, 1, frames, height, width)
    mask[:, :, :2] = 1
    return {
        "latents": torch.randn(batch, 16, frames, height, width, generator=draw),
        "times": 0.9 * (1 - mask[:, 0, :, 0, 0]),
        "condition_mask": mask,
        "padding_mask": torch.zeros(batch, 1, 8 * height, 8 * width),
        "text": text,
    }


def test_the_published_checkpoint_loads_strictly(manifest):
    stored = {name: torch.empty(shape, device="meta") for name, (shape, _) in manifest["dit"].items()}
    assert len(stored) == 574
    weights = dit_tensors(stored)
    assert len(stored) - len(weights) == 4
    config = infer_dit_config(weights, DitConfig())
    assert config == DitConfig()
    with torch.device("meta"):
        model = Dit(config)
    model.load_state_dict(weights, strict=True, assign=True)
    assert sum(parameter.numel() for parameter in model.parameters()) == 1_956_413_440


def test_the_published_image_encoder_has_our_names_and_shapes(manifest):
    pytest.importorskip("diffusers")
    stored = {name: torch.empty(shape, device="meta") for name, shape in manifest["vae"].items()}
    config = infer_vae_config(stored, VaeConfig())
    assert config == VaeConfig()
    found = {name: tuple(tensor.shape) for name, tensor in stored.items()}
    assert len(found) == 194
    assert found == expected_vae_shapes(config)


def test_rotary_buffers_come_from_the_checkpoint(weights):
    changed = dict(weights)
    changed["pos_embedder.dim_temporal_range"] = weights["pos_embedder.dim_temporal_range"] * 1.01
    cosine, _ = build_dit(DUMMY_CONFIG.dit, weights).pos_embedder(3, 2, 2)
    other, _ = build_dit(DUMMY_CONFIG.dit, changed).pos_embedder(3, 2, 2)
    assert not torch.equal(cosine, other)
    rounded = build_dit(DUMMY_CONFIG.dit, changed, dtype=torch.bfloat16).pos_embedder.dim_temporal_range
    assert rounded.dtype == torch.float32
    assert torch.equal(rounded, changed["pos_embedder.dim_temporal_range"].bfloat16().float())


def test_a_rotation_keeps_lengths_and_sees_only_distances(dit):
    cosine, sine = dit.pos_embedder(4, 1, 1)
    x = torch.randn(1, 1, 4, DUMMY_CONFIG.dit.head_dim, generator=torch.Generator().manual_seed(0))
    same = x[:, :, :1].expand_as(x)
    turned = rotate(same, cosine, sine)
    torch.testing.assert_close(turned.norm(dim=-1), same.norm(dim=-1))
    products = turned[0, 0] @ turned[0, 0].T
    torch.testing.assert_close(products[0, 1], products[2, 3])


def test_padded_text_is_an_exact_null_sink(dit):
    observer, inputs = EverythingObserver(), make_inputs()
    dit(**inputs, observer=observer)
    rows = observer.probabilities("cross", 0)
    assert (rows[..., 3:] == rows[..., 3:4]).all()
    shorter = dict(inputs, text=torch.zeros_like(inputs["text"]))
    empty = EverythingObserver()
    dit(**shorter, observer=empty)
    for layer in range(DUMMY_CONFIG.dit.num_blocks):
        assert (empty.residual_norms[layer][..., 1] == 0).all()
        assert (observer.residual_norms[layer][..., 1] > 0).all()


def test_bfloat16_rounds_the_times(weights):
    model = build_dit(DUMMY_CONFIG.dit, weights, dtype=torch.bfloat16)
    inputs = make_inputs()
    t = 0.98765
    exact = model(**dict(inputs, times=torch.full((1, 5), t)))
    rounded = model(**dict(inputs, times=torch.full((1, 5), 0.98828125)))
    assert exact.dtype == torch.bfloat16
    assert torch.equal(exact, rounded)


@st.composite
def networks_and_batches(draw):
    """Any sizes: odd numbers of frames, rectangles, batches with different masks, times and lengths of text."""
    heads, head_dim = draw(st.integers(1, 4)), draw(st.sampled_from([12, 14, 16, 18, 20, 32]))
    channels = draw(st.sampled_from([4, 16]))
    config = DitConfig(
        width=heads * head_dim,
        num_blocks=draw(st.integers(1, 3)),
        num_heads=heads,
        mlp_dim=16,
        text_dim=draw(st.sampled_from([8, 20])),
        adaln_dim=draw(st.sampled_from([4, 8])),
        in_channels=channels,
        out_channels=channels,
    )
    batch, frames, positions = draw(st.integers(1, 3)), draw(st.integers(1, 11)), draw(st.integers(1, 12))
    height, width = 2 * draw(st.integers(1, 4)), 2 * draw(st.integers(1, 6))
    lengths = [draw(st.integers(0, positions)) for _ in range(batch)]
    random = torch.Generator().manual_seed(draw(st.integers(0, 2**16)))
    given_frames = (torch.rand(batch, 1, frames, 1, 1, generator=random) < 0.5).float()
    text = torch.randn(batch, positions, config.text_dim, generator=random)
    for entry, length in enumerate(lengths):
        text[entry, length:] = 0
    inputs = {
        "latents": torch.randn(batch, channels, frames, height, width, generator=random),
        "times": torch.rand(batch, frames, generator=random) * (1 - given_frames[:, 0, :, 0, 0]),
        "condition_mask": given_frames.expand(batch, 1, frames, height, width).contiguous(),
        "padding_mask": (torch.rand(batch, 1, 8 * height, 8 * width, generator=random) < 0.3).float(),
        "text": text,
    }
    return config, inputs, lengths


@settings(max_examples=examples(10), deadline=None)
@given(case=networks_and_batches())
def test_any_network_on_any_batch(case):
    config, inputs, lengths = case
    dit, observer = build_dit(config, random_dit_weights(config, seed=0)), EverythingObserver()
    with torch.no_grad():
        output = dit(**inputs)
        assert output.shape == inputs["latents"].shape
        assert torch.equal(dit(**inputs, observer=observer), output)
        for entry in range(len(lengths)):
            alone = dit(**{name: tensor[entry : entry + 1] for name, tensor in inputs.items()})
            torch.testing.assert_close(output[entry : entry + 1], alone, rtol=1e-4, atol=2e-5)
    keys = {"self": output.shape[2] * output.shape[3] * output.shape[4] // 4, "cross": inputs["text"].shape[1]}
    for layer in range(config.num_blocks):
        for site, count in keys.items():
            rows = observer.probabilities(site, layer)
            assert rows.shape == (len(lengths), config.num_heads, keys["self"], count)
            torch.testing.assert_close(rows.sum(-1), torch.ones(rows.shape[:-1]), rtol=0, atol=1e-5)
        cross = observer.probabilities("cross", layer)
        for entry, length in enumerate(lengths):
            # All padded positions are equal for every query, and a text of padding only adds exactly nothing.
            assert (cross[entry, ..., length:] == cross[entry, ..., length : length + 1]).all()
            assert bool((observer.residual_norms[layer][entry, :, 1] == 0).all()) == (length == 0)
