"""The policy behind its interface: two sites, layouts, and actions that do not depend on the recording."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch

from tests.kit.cosmos_helpers import INSTRUCTION, OTHER_INSTRUCTION, recorders_of
from tests.kit.policy_inputs import KeepAll, assert_same_input, make_observation
from vla_attention.capture.policies.cosmos.config import LIBERO_FRAMES, CosmosConfig, FrameConfig
from vla_attention.capture.policies.cosmos.embedded import DUMMY_CONFIG, EMBEDDED_CONFIG, random_policy
from vla_attention.capture.policies.cosmos.family import CosmosSettings
from vla_attention.capture.policies.cosmos.latents import cross_layout, self_layout
from vla_attention.capture.policies.cosmos.loading import build_cosmos_policy, check_call_length
from vla_attention.capture.recording.recorder import AttentionRecorder, RecordingPlan
from vla_attention.schemas.errors import BadArgument, UnknownName
from vla_attention.schemas.layout import Role, camera_grids


def recorders_for(policy, queries="mean"):
    layers, heads = tuple(range(policy.num_layers)), tuple(range(policy.num_heads))
    steps = tuple(range(policy.num_denoise_steps))
    return {
        site.name: AttentionRecorder(RecordingPlan(layers, steps, heads, queries, site.name), site.num_keys)
        for site in policy.sites
    }


def test_actions_are_bit_equal_with_and_without_recording(dummy, prepared):
    plain = dummy.act(prepared, 195)
    assert np.array_equal(plain, dummy.act(prepared, 195, recorders_of(dummy, prepared)))
    assert np.array_equal(plain, dummy.act(prepared, 195, recorders_for(dummy)))
    assert plain.shape == (16, 7)


def test_queries_are_pooled_by_action_step(dummy, prepared):
    plan = RecordingPlan((1,), (0,), (0, 1), "steps", "self")
    pools, keep = dummy.query_pools(), KeepAll()
    recorder = AttentionRecorder(plan, dummy.sites[0].num_keys, pools=pools)
    dummy.act(prepared, 195, {"self": recorder})
    dummy.act(prepared, 195, {"self": keep})
    rows = recorder.finish().rows
    assert rows.shape == (1, 1, 2, 16 * 7, 144)
    np.testing.assert_allclose(rows[0, 0], pools @ keep.rows[1, 0][0].numpy(), atol=1e-6)
    with pytest.raises(BadArgument, match="per action step"):
        dummy.act(prepared, 195, {"self": AttentionRecorder(plan, dummy.sites[0].num_keys)})


def test_rows_are_those_of_the_action_frame_only(dummy, prepared):
    keep = {"self": KeepAll(), "cross": KeepAll()}
    dummy.act(prepared, 195, keep)
    tokens = dummy.config.tokens_per_frame
    for collector in keep.values():
        assert {rows.shape[2] for rows in collector.rows.values()} == {tokens}
        assert collector.queries == {(0, tokens)}


def test_another_query_frame_has_other_rows(dummy, prepared):
    other = random_policy("untrained-tiny", DUMMY_CONFIG, query_frame="curr_last")
    assert other.query_frame == "primary"
    ours, theirs = recorders_for(dummy), recorders_for(other)
    actions = dummy.act(prepared, 195, ours)
    assert np.array_equal(other.act(prepared, 195, theirs), actions)
    assert not np.array_equal(ours["self"].finish().rows, theirs["self"].finish().rows)
    with pytest.raises(BadArgument, match="'primary'"):
        other.query_pools()
    assert dummy.query_pools().shape == (16 * 7, 16)


def test_the_published_layout():
    layout = self_layout(CosmosConfig())
    assert layout.num_keys == 1764
    assert tuple(span.name for span in layout.spans) == LIBERO_FRAMES
    assert {span.kind for span in layout.spans} == {"latent"}
    action = layout.span("action")
    assert (action.start, action.stop) == (784, 980)
    assert layout.cameras == ("wrist", "primary")
    (grid,) = layout.grids("primary")
    assert (grid.rows, grid.columns, grid.image_height) == (14, 14, 224)
    assert cross_layout(CosmosConfig()).num_keys == 512
    assert self_layout(EMBEDDED_CONFIG).num_keys == 441


def test_roles_of_every_key(dummy, prepared):
    layout = dummy.sites[0]
    expected = [Role.BLANK, Role.PROPRIO, Role.IMAGE, Role.IMAGE, Role.ACTION]
    expected += [Role.FUTURE, Role.FUTURE, Role.FUTURE, Role.VALUE]
    for span, role in zip(layout.spans, expected, strict=True):
        assert (prepared.key_role["self"][span.start : span.stop] == role).all(), span.name
    cross = prepared.key_role["cross"]
    real = prepared.tensors["text"][0].ne(0).any(dim=-1).numpy()
    assert ((cross != Role.NULL) == real).all()
    assert prepared.prompt.instruction_text == INSTRUCTION


def test_frames_are_what_the_model_sees(dummy, prepared):
    assert list(prepared.frames) == ["wrist", "primary"]
    assert {frame.shape for frame in prepared.frames.values()} == {(64, 64, 3)}
    assert prepared.state.shape == (9,)
    for camera in dummy.cameras:
        assert camera.upright
        assert not camera.mirrored
        assert camera.visible == pytest.approx(212 / 224)
        (grid,) = camera_grids(dummy.sites, camera.name)
        assert (grid.rows, grid.image_width) == (4, 64)


def test_what_a_call_was_given_gives_the_same_input_again(dummy, prepared):
    assert not dummy.needs_camera_frames
    assert_same_input(dummy.prepare_again(prepared.given), prepared)


def test_a_changed_picture_and_no_words_reach_the_model(dummy, prepared):
    grey = {**prepared.frames, "wrist": np.full_like(prepared.frames["wrist"], 51)}
    changed = dummy.prepare_again(dataclasses.replace(prepared.given, frames=grey, instruction=""))
    assert not torch.equal(changed.tensors["given"], prepared.tensors["given"])
    assert Role.INSTRUCTION not in changed.key_role["cross"]
    assert np.isfinite(dummy.act(changed, 195)).all()


def test_frames_are_found_by_name_and_number():
    frames = FrameConfig()
    assert [frames.index(name) for name in ("action", "frame4", "curr_last", "primary", "frame0")] == [4, 4, 3, 3, 0]
    for wrong in ("acton", "frame9", "frame", "9"):
        with pytest.raises(UnknownName, match=rf"'{wrong}'.*blank, proprio, wrist.*frame0 to frame8"):
            frames.index(wrong)


def test_a_call_that_never_was_is_an_error():
    config = CosmosConfig()
    check_call_length(config, 1764)
    check_call_length(config, None)
    with pytest.raises(BadArgument, match=r"--prefer-S 1000: .* 5 .* 1764"):
        check_call_length(config, 1000)


def test_denoise_times_and_noise_seeds(dummy):
    times = dummy.denoise_times()
    assert len(times) == dummy.num_denoise_steps == 3
    assert times[0] == pytest.approx(80 / 81)
    assert times[-1] == pytest.approx(0.8)
    assert dummy.replan_noise_seed(195, 3, 2, 7) == 195


@pytest.mark.parametrize(
    ("options", "named"),
    [
        ({"num_open_loop_steps": 17}, "--num-open-loop-steps 17: .* 16 "),
        ({"query_frame": "acton"}, "'acton'.*'action'"),
        ({"prefer_s": 1764}, "--prefer-S 1764: .* 3 .* 144"),
    ],
)
def test_options_that_cannot_be_are_refused_by_name(options, named):
    pytest.importorskip("diffusers")
    with pytest.raises((BadArgument, UnknownName), match=named):
        build_cosmos_policy(CosmosSettings("untrained-tiny", **options), "cpu")


def test_swapping_only_the_embedding_under_the_same_noise_changes_the_actions(dummy, prepared):
    """With equal pictures, proprioception and noise, every difference comes through cross-attention."""
    other = dummy.prepare(make_observation(0), OTHER_INSTRUCTION).tensors["text"]
    assert not torch.equal(other, prepared.tensors["text"])
    swapped = dataclasses.replace(prepared, tensors=dict(prepared.tensors, text=other))
    before, after = KeepAll(), KeepAll()
    actions = dummy.act(prepared, 195, {"self": before})
    changed = dummy.act(swapped, 195, {"self": after})
    assert np.abs(changed - actions).max() > 1e-4
    assert np.array_equal(dummy.act(prepared, 195), actions)
    # The first block's self-attention comes before any text: at the first call it does not depend on the embedding.
    assert torch.equal(before.rows[0, 0], after.rows[0, 0])
    assert not torch.equal(before.rows[1, 0], after.rows[1, 0])
