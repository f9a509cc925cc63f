"""The model server of examples/vla_eval_server.py with a small random pi0; `vla-eval serve` runs this file."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from vla_eval.model_servers.serve import run_server

# examples/vla_eval_server.py, copied beside this file.
from vla_eval_server import RecordingServer

import vla_attention as va
from tests.policies import pi0_model
from tests.policies.word_tokenizer import WordTokenizer


class SmallServer(RecordingServer):
    """pi0 with random weights."""

    def load(self, checkpoint: str) -> tuple[Any, va.PolicyLayout, Any]:
        policy = pi0_model.small_pi0()
        layout = va.layouts.pi0_transformers(policy, cameras=pi0_model.CAMERAS, prompt_tokens=pi0_model.LONGEST)
        return policy, layout, WordTokenizer()

    def chunk(self, obs: dict[str, Any]) -> np.ndarray:
        given = pi0_model.inputs(instruction=obs["task_description"])
        pictures = np.stack([obs["images"][name] for name in pi0_model.CAMERAS])
        given["pixel_values"] = torch.from_numpy(pictures).permute(0, 3, 1, 2)[None] / 127.5 - 1
        given["state"] = torch.from_numpy(np.float32(obs["states"]))[None]
        return self.policy.sample_actions(**given)[0].numpy()


if __name__ == "__main__":
    run_server(SmallServer)
