"""Record attention inside openpi's websocket server: the policy in the server is wrapped, nothing else changes.

Instead of `scripts/serve_policy.py` of openpi, with a PyTorch checkpoint:

    python openpi_recorded.py runs/droid.zarr pi0_libero checkpoints/pi0_libero_pytorch --port 8000

The protocol has no episodes: the client says in one more key of its observation which episode and step a call belongs
to, and at the end whether it was solved. A call without that key is answered and not recorded.

    client.infer({**observation, "episode": {"task_id": 0, "episode_index": 3, "env_step": step}})
    client.infer({"episode": {"ended": True, "success": True, "num_steps": step}})
"""

from __future__ import annotations

import argparse
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
from openpi_client import base_policy

import vla_attention as va


class RecordingPolicy(base_policy.BasePolicy):
    """Answers as the policy does, and records the calls of episodes.

    Args:
        policy: openpi's `Policy`, or any other with `infer`, that holds the network.
        store: the store to write, `NAME.zarr`; one that is there is continued.
        layout: None: that of openpi's PyTorch network.
        frames: an observation -> pictures by the layout's cameras; None: none are stored.
        settings: further arguments of `va.record`, such as `tokenizer`.
    """

    def __init__(
        self, policy: Any, store: str, layout: va.PolicyLayout | None = None, frames: Any = None, **settings: Any
    ) -> None:
        self.policy = policy
        self.frames = frames
        settings = {"layout": layout or va.layouts.pi0_pytorch(policy), "resume": Path(store).exists(), **settings}
        self.run = va.record(store, policy, **settings).__enter__()
        self.name: tuple[int, int] | None = None
        self.episode: Any = None
        self.stack = ExitStack()

    def infer(self, obs: dict[str, Any]) -> dict[str, Any]:
        """Answer one observation."""
        facts = obs.get("episode")
        rest = {name: value for name, value in obs.items() if name != "episode"}
        if facts is None:
            return self.policy.infer(rest)
        if facts.get("ended"):
            self._end(facts)
            return {}
        name = int(facts["task_id"]), int(facts["episode_index"])
        if name != self.name:
            self._begin(name, str(rest["prompt"]))
        if self.episode is None:
            return self.policy.infer(rest)
        frames = None if self.frames is None else self.frames(rest)
        with self.episode.replan(env_step=int(facts["env_step"]), frames=frames) as replan:
            answer = self.policy.infer(rest)
            replan.actions = np.asarray(answer["actions"])
        return answer

    def _begin(self, name: tuple[int, int], prompt: str) -> None:
        # An episode that did not end is dropped: its connection was lost.
        self.stack.__exit__(ConnectionError, ConnectionError("The episode did not end."), None)
        self.name, self.episode, self.stack = name, None, ExitStack()
        if not self.run.has(*name):
            facts = {"task_id": name[0], "episode_index": name[1], "instruction": prompt}
            self.episode = self.stack.enter_context(self.run.episode(**facts))

    def _end(self, facts: dict[str, Any]) -> None:
        if self.episode is not None:
            self.episode.success = facts.get("success")
            self.episode.num_steps = facts.get("num_steps")
        self.name = self.episode = None
        self.stack.close()


def main() -> None:
    """Serve a PyTorch checkpoint of openpi, as its own script does."""
    from openpi.models import tokenizer
    from openpi.policies import policy_config
    from openpi.serving.websocket_policy_server import WebsocketPolicyServer
    from openpi.training import config

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("store")
    parser.add_argument("config")
    parser.add_argument("checkpoint")
    parser.add_argument("--port", type=int, default=8000)
    given = parser.parse_args()
    policy = policy_config.create_trained_policy(config.get_config(given.config), given.checkpoint)
    words = tokenizer.PaligemmaTokenizer()._tokenizer
    recording = RecordingPolicy(policy, given.store, tokenizer=words, checkpoint=given.checkpoint)
    WebsocketPolicyServer(recording, port=given.port, metadata=policy.metadata).serve_forever()


if __name__ == "__main__":
    main()
