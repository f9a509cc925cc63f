"""ACT of LeRobot: the real class with small random weights, in 0.4.4 on a stand-in for torchvision's ResNet."""

from __future__ import annotations

import numpy as np
import pytest
import torch

pytest.importorskip("lerobot", reason="run by make test-policies, in .venv-lerobot")

import vla_attention as va
from tests.policies import lerobot_models as models
from tests.policies.policy_checks import (
    PolicyCase,
    check_analysis,
    check_contributions,
    check_rows,
    check_uniform_attention,
    record,
    roles_of,
    rows_of,
)

CHUNK, LAYERS, ROWS, COLUMNS = 5, 3, 2, 3


@pytest.fixture(scope="module")
def case():
    policy = models.small_act()
    given = models.observation(64, 96)
    frames, state = models.frames_of(given), given["observation.state"]
    return PolicyCase(policy, va.layouts.act(policy), models.chunk_of(policy), given, frames, state)


@pytest.mark.parametrize("site", ["cross", "self"])
def test_rows_are_those_that_the_modules_give_when_asked_for_weights(case, tmp_path, site):
    store = record(case, tmp_path, tokenizer=None)
    name = "multihead_attn" if site == "cross" else "self_attn"
    modules = [getattr(layer, name) for layer in case.policy.model.decoder.layers]
    kept: list[torch.Tensor] = []

    def asked(module, inputs, named):
        named = {**named, "need_weights": True, "average_attn_weights": False}
        return inputs, named

    def keep(_module, _inputs, output):
        kept.append(output[1][0])

    handles = [module.register_forward_pre_hook(asked, with_kwargs=True) for module in modules]
    handles += [module.register_forward_hook(keep) for module in modules]
    case.call(case.observation)
    for handle in handles:
        handle.remove()
    check_rows(store, site, torch.stack(kept)[:, None].detach().numpy())


def test_keys_are_the_latent_the_state_and_feature_maps_of_the_picture_s_shape(case, tmp_path):
    store = record(case, tmp_path, tokenizer=None)
    assert roles_of(store, "cross") == ["learned", "state", *["image"] * (2 * ROWS * COLUMNS)]
    assert roles_of(store, "self") == ["action"] * CHUNK
    (grid,) = store.attributes.sites[0].grids("wrist")
    assert (grid.rows, grid.columns, grid.image_height, grid.image_width) == (ROWS, COLUMNS, 64, 96)


def test_the_feature_map_s_order_is_row_by_row(case):
    # A real ResNet's receptive field is larger than the picture: the map's own places are compared.
    model, maps, tokens = case.policy.model, [], []
    handles = [
        model.encoder_img_feat_input_proj.register_forward_hook(lambda _module, _given, output: maps.append(output)),
        model.encoder.register_forward_pre_hook(lambda _module, given: tokens.append(given[0])),
    ]
    case.call(case.observation)
    for handle in handles:
        handle.remove()
    for camera, features in zip(models.CAMERAS, maps, strict=True):
        (span,) = case.layout.site("cross").keys.camera_spans(camera)
        assert features.shape[-2:] == (ROWS, COLUMNS)
        torch.testing.assert_close(tokens[0][span.start : span.stop, 0], features[0].flatten(1).T, rtol=0, atol=0)


@pytest.mark.parametrize("site", ["self", "cross"])
def test_contributions_are_what_the_layers_add(case, tmp_path, site):
    layers = case.policy.model.decoder.layers

    def stream(block):
        layer = layers[block]
        before = (layer, "given") if site == "self" else (layer.norm1, "returned")
        return before, (layer.norm1 if site == "self" else layer.norm2, "given")

    part = "self_attn" if site == "self" else "multihead_attn"
    projection = f"model.decoder.layers.{{block}}.{part}.out_proj"
    check_contributions(case, record(case, tmp_path, tokenizer=None), site, stream, projection)


def test_a_knockout_takes_the_keys_mass_away(case, tmp_path):
    rows = rows_of(
        record(case, tmp_path, replans=1, tokenizer=None, interventions=va.knockout("camera:wrist")), "cross"
    )
    assert not rows[..., -ROWS * COLUMNS :].any()
    np.testing.assert_allclose(rows.sum(axis=-1), 1, atol=1e-5)


def test_the_analysis_answers_without_a_ratio(case, tmp_path):
    record(case, tmp_path, tokenizer=None)
    check_analysis(tmp_path, ["cross", "self"], ratios=False)


def test_queries_of_zero_have_lift_1(case, tmp_path):
    check_uniform_attention(case, tmp_path, tokenizer=None)
