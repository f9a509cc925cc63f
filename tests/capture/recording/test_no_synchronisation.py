"""A recorded call never waits for a GPU, from its pictures to its actions, and moves what it recorded in one copy.

The device is torch's meta device, whose tensors have shapes and no numbers: an operation that needs a number
(`.item()`, `.cpu()`, a choice by value) is an error there, as it would be a wait on a GPU. Copies to the device are
collected; there is none inside of the denoise steps.
"""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch.utils._python_dispatch import TorchDispatchMode

from vla_attention.capture.policies.pi.embedded import DUMMY_CONFIG
from vla_attention.capture.policies.pi.gemma import KeysValues, Rotation
from vla_attention.capture.policies.pi.model import Denoising, PiModel
from vla_attention.capture.recording.recorder import AttentionRecorder, RecordingPlan

GPU = torch.device("meta")
CONFIG = DUMMY_CONFIG
KEYS = CONFIG.prefix_len + CONFIG.suffix_len


class Transfers(TorchDispatchMode):
    """Collects the copies between devices."""

    def __init__(self) -> None:
        super().__init__()
        self.found: list[str] = []

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        made = func(*args, **(kwargs or {}))
        devices = {
            tensor.device.type
            for value in (*args, *(kwargs or {}).values(), made)
            for tensor in (value if isinstance(value, (list, tuple)) else [value])
            if isinstance(tensor, torch.Tensor)
        }
        if func._schema.name in ("aten::_to_copy", "aten::copy_") and len(devices) > 1:
            self.found.append(func._schema.name)
        return made


def recorder_of(queries: str) -> AttentionRecorder:
    plan = RecordingPlan((0, 1, 2), (0, 1, 2), (5, 0), queries, "joint")
    parts = np.zeros((KEYS, 3), dtype=bool)
    parts[:4, 0], parts[4::2, 1], parts[5::2, 2] = True, True, True
    pools = np.eye(4)[:2] if queries == "steps" else None
    return AttentionRecorder(plan, KEYS, parts, pools)


def fake_call(recorder: AttentionRecorder, dtype: torch.dtype) -> tuple[list[str], list[str], list[torch.Tensor]]:
    """The transfers of the steps, those after them, and what was recorded, on a fake GPU."""
    with GPU:
        model = PiModel(CONFIG, dtype)
    with torch.no_grad():
        expert = CONFIG.action_expert

        def keys() -> torch.Tensor:
            return torch.empty(1, expert.num_kv_heads, CONFIG.prefix_len, expert.head_dim, device=GPU, dtype=dtype)

        denoising = Denoising(
            torch.empty(1, CONFIG.action_dim, device=GPU),
            Rotation.at(torch.zeros(1, CONFIG.suffix_len, dtype=torch.int64, device=GPU), expert.head_dim),
            torch.ones(1, CONFIG.suffix_len, KEYS, dtype=torch.bool, device=GPU),
            tuple(KeysValues(keys(), keys()) for _ in range(expert.depth)),
            None,
        )
        x = torch.empty(1, CONFIG.action_horizon, CONFIG.action_dim, device=GPU)
        recorder.begin_call(denoising.mask[0].any(dim=0), slice(0, CONFIG.prefix_len), None)
        with Transfers() as inside:
            for step in range(3):
                x = x - model.velocity(x, step, torch.empty(expert.width, device=GPU), denoising, recorder)
        with Transfers() as after:
            recorded = recorder.on_device()
    return inside.found, after.found, recorded


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
@pytest.mark.parametrize("queries", ["mean", "steps", "all"])
def test_nothing_waits_for_the_gpu_in_the_denoise_steps(queries, dtype):
    inside, after, recorded = fake_call(recorder_of(queries), dtype)
    assert inside == []
    assert after == []
    assert {tensor.device for tensor in recorded} == {GPU}
    length = {"mean": 1, "steps": 2, "all": 4}[queries]
    assert [tuple(tensor.shape) for tensor in recorded] == [(9, 2, length, KEYS), (9, 4, 4)]


def whole_call(recorder: AttentionRecorder, masks: torch.device) -> tuple[list[str], list[int]]:
    """Make a policy call on the fake GPU; return its transfers, and how many there were when each block began."""
    with GPU:
        model = PiModel(CONFIG)
    begun: list[int] = []

    class Noting(type(recorder)):
        def begin_block(self, layer, denoise_step):
            begun.append(len(inside.found))

    noting = Noting(recorder.plan, recorder.num_keys, recorder.parts, recorder.pools)
    size = CONFIG.siglip.image_size
    first, *others = CONFIG.cameras
    words = torch.arange(CONFIG.max_token_len)[None] < 9
    with Transfers() as inside:
        model.sample_actions(
            images={camera: torch.empty(1, 3, size, size, device=GPU) for camera in CONFIG.cameras},
            image_masks={first: torch.tensor([True], device=masks)}
            | {camera: torch.tensor([False], device=masks) for camera in others},
            tokens=torch.empty(1, CONFIG.max_token_len, dtype=torch.int64, device=GPU),
            token_mask=words.to(masks),
            state=torch.empty(1, CONFIG.action_dim, device=GPU),
            noise=torch.empty(1, CONFIG.action_horizon, CONFIG.action_dim, device=GPU),
            recorder=noting,
        )
        assert {tensor.device for tensor in noting.on_device()} == {GPU}
    return inside.found, begun


@pytest.mark.parametrize("queries", ["mean", "steps", "all"])
def test_nothing_waits_for_the_gpu_in_the_whole_policy_call(queries):
    """Masks and times go there before the first block. Nothing comes back: on this device that would be an error."""
    found, begun = whole_call(recorder_of(queries), torch.device("cpu"))
    assert len(begun) == 3 * CONFIG.action_expert.depth
    assert begun == [len(found)] * len(begun)
