"""A third policy family, as a user would add it: a tiny attention model, and an entry for the registry."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from vla_attention.capture.environments.episode_protocol import OPENPI
from vla_attention.capture.policies.family import ModelSettings, PolicyFamily, checkpoint_option
from vla_attention.schemas.options import option


@dataclass(frozen=True)
class ToySettings(ModelSettings):
    checkpoint: str = checkpoint_option("weights", "toy-weights")
    toy_size: int = option("actions of a chunk", 4)

    def build(self, device: str) -> Any:
        return make_toy_policy(self.checkpoint, self.toy_size)

    def analysis_arguments(self) -> list[str]:
        return ["--group", "seen=camera:view", "--group", "read=role:instruction", "--ratio", "seen/read"]


def make_toy_policy(checkpoint: str, size: int) -> Any:
    """Return a policy of one attention layer: two heads over four patches of a picture and three words."""
    import numpy as np
    import torch

    from vla_attention.capture.policies.identity import PolicySource, describe_policy
    from vla_attention.capture.policies.noise import initial_noise, noise_seed
    from vla_attention.capture.policies.policy import GivenInputs, PolicyInput, camera_frame
    from vla_attention.capture.recording.attention import CallKeys, attend
    from vla_attention.schemas.layout import PatchGrid, Piece, Prompt, Role, SiteLayout, Span, roles_from_spans
    from vla_attention.schemas.stores.store_format import PolicyCameraView

    layout = SiteLayout(
        "joint",
        (Span("view", "image", 0, 4, camera="view", grid=PatchGrid(2, 2, 4, 4)), Span("prompt", "text", 4, 7)),
    )

    class ToyPolicy:
        name, family = "toy", "toy"
        model = torch.nn.Identity()
        sites = (layout,)
        num_layers, num_heads, num_denoise_steps = 1, 2, 1
        action_horizon = num_action_queries = size
        default_protocol = OPENPI
        default_replan_steps = 2
        needs_camera_frames = False
        has_prefix = False
        cameras = (PolicyCameraView("view", source="agentview", upright=True, mirrored=False),)

        def query_pools(self):
            return np.eye(size)

        def replan_noise_seed(self, run_seed, task_id, episode_index, replan):
            return noise_seed(run_seed, task_id, episode_index, replan)

        def denoise_times(self):
            return np.ones(1)

        def identity(self):
            source = PolicySource("toy", checkpoint, "toy", untrained=False)
            return describe_policy(self, source, "0" * 64, {"size": size})

        def prepare(self, observation, instruction):
            frame = camera_frame(observation, "agentview")[::-1].copy()
            return self.prepare_again(GivenInputs({"view": frame}, {}, np.zeros(8), instruction))

        def prepare_again(self, given):
            frame, instruction = given.frames["view"], given.instruction
            words = instruction.split()[:3]
            starts = [instruction.index(word) for word in words]
            pieces = tuple(Piece(4 + i, w, a, a + len(w)) for i, (w, a) in enumerate(zip(words, starts, strict=True)))
            roles = roles_from_spans(layout, {"view": Role.IMAGE, "prompt": Role.INSTRUCTION})
            prompt = Prompt(instruction, pieces, (0, len(instruction)))
            patches = torch.from_numpy(frame.reshape(2, 2, 2, 2, 3).mean((1, 3, 4)).reshape(4)).float() / 255
            keys = torch.cat([patches, torch.tensor([len(word) / 10 for word in words])])
            return PolicyInput({"view": frame}, {"joint": roles}, prompt, np.zeros(8), {"keys": keys})

        def act(self, policy_input, noise_seed, recorders=None, editors=None):
            keys = policy_input.tensors["keys"].expand(1, 1, 1, -1).transpose(-1, -2).expand(1, 1, 7, 4)
            query = torch.from_numpy(initial_noise(noise_seed, (1, 2, size, 4)))
            collector = (recorders or {}).get("joint")
            rows_to = collector.sink(0, 0, slice(0, size)) if collector is not None else None
            editor = (editors or {}).get("joint")
            change = editor.change(0, 0, CallKeys(slice(0, size), None)) if editor is not None else None
            mixed = attend(query, keys, keys, None, 0.5, change=change, rows_to=rows_to)
            return np.repeat(mixed[0, 0, :, :1].numpy().astype(np.float64), 7, axis=1)

    return ToyPolicy()


FAMILY = PolicyFamily(
    name="toy",
    title="Toy Policy",
    description="Record a toy policy.",
    examples="  vla-attention capture toy\n",
    settings=ToySettings,
    store_prefix="toy_",
    replan_default="2",
)
