"""Contributions of Cosmos's two sites: their sum is the update, they agree with the reference, padding adds nothing."""

from __future__ import annotations

import numpy as np
import torch

from tests.kit.cosmos_helpers import GOLDEN, recorders_of
from tests.kit.cosmos_parity import read_case
from vla_attention.capture.policies.cosmos import dit
from vla_attention.capture.policies.cosmos.model import CallObserver
from vla_attention.capture.recording.recorder import AttentionRecorder, RecordingPlan


def grams_of(policy, prepared):
    recorders = recorders_of(policy, prepared)
    policy.act(prepared, 3, recorders)
    return {site: recorder.finish().contribution.astype(np.float64) for site, recorder in recorders.items()}


def norm(gram, members):
    return np.sqrt(gram[..., members, :][..., members].sum(axis=(-2, -1)))


def test_parts_add_up_to_the_gated_update_of_each_site(dummy, prepared):
    for site, gram in grams_of(dummy, prepared).items():
        whole = gram.shape[-1] - 1
        # The sum of the parts is the update, in length and direction: their inner product is the update's square.
        np.testing.assert_allclose(gram[..., :whole, whole].sum(axis=-1), gram[..., whole, whole], rtol=1e-4)
        np.testing.assert_allclose(norm(gram, range(whole)), norm(gram, [whole]), rtol=1e-4, err_msg=site)


def test_updates_are_what_the_blocks_add_to_the_residual_stream(dummy, prepared, monkeypatch):
    streams: list[torch.Tensor] = []
    own = dit.modulate

    def kept(x, shift, scale):
        streams.append(x[0, dummy.config.frames.index(dummy.query_frame)].clone())
        return own(x, shift, scale)

    monkeypatch.setattr(dit, "modulate", kept)
    grams = grams_of(dummy, prepared)
    layers, steps = dummy.num_layers, dummy.num_denoise_steps
    # Each block reads the stream before self-attention, cross-attention and feed-forward, and the final layer once.
    before = torch.stack(streams).unflatten(0, (steps, 3 * layers + 1))[:, :-1].unflatten(1, (layers, 3))
    added = before.diff(dim=2).square().sum(dim=-1).mean(dim=-1)  # (denoise step, layer, site)
    for number, site in enumerate(("self", "cross")):
        expected = added[..., number].T.double().numpy()
        np.testing.assert_allclose(grams[site][..., -1, -1], expected, rtol=1e-4)
        np.testing.assert_allclose(norm(grams[site], range(grams[site].shape[-1] - 1)) ** 2, expected, rtol=1e-4)


def test_padded_text_contributes_exactly_nothing(dummy, prepared):
    gram = grams_of(dummy, prepared)["cross"]
    assert (gram[..., 2, :] == 0).all()
    assert (norm(gram, [0, 1]) > 0).all()
    silent = dict(prepared.tensors, text=torch.zeros_like(prepared.tensors["text"]))
    assert (grams_of(dummy, type(prepared)(**{**vars(prepared), "tensors": silent}))["cross"] == 0).all()


def test_norms_of_frames_are_those_of_the_reference():
    """Root mean squares over a frame's queries, from the Gram matrix, against the reference's norm of each query."""
    case = read_case(GOLDEN / "dit_batch2_T5_rect")
    model, tokens, frames = case.build_dit("cpu"), 15, 5
    parts = np.repeat(np.eye(frames, dtype=bool), tokens, axis=0)
    names = ("latents", "timesteps", "condition_mask", "padding_mask", "text_embeddings")
    for entry, frame in [(0, 2), (1, 4)]:
        plan = RecordingPlan((0, 1), (0,), (0, 1), "mean", "self")
        recorder = AttentionRecorder(plan, frames * tokens, parts)
        observer = CallObserver(0, frame, tokens, {"self": recorder})
        with torch.no_grad():
            model(*(torch.from_numpy(case.inputs[name][entry : entry + 1]) for name in names), observer)
        grams = recorder.finish().contribution[:, 0].astype(np.float64)
        for layer, gram in enumerate(grams):
            norms = case.expected[f"frame_contrib_norms_{layer:02d}"][entry, frame * tokens : (frame + 1) * tokens]
            expected = np.sqrt((norms.astype(np.float64) ** 2).mean(axis=0))
            np.testing.assert_allclose(np.sqrt(np.diag(gram))[:frames], expected[:frames], rtol=1e-5)
            whole = case.expected[f"residual_norms_{layer:02d}"][entry, frame * tokens : (frame + 1) * tokens, 0]
            np.testing.assert_allclose(gram[-1, -1], (whole.astype(np.float64) ** 2).mean(), rtol=1e-5)
