"""Record attention inside vla-eval: a model server that stores every policy call of the episodes it serves.

Copy this file, change `load` and `chunk` to your policy, and serve it. vla-eval runs any of its benchmarks against it,
in containers or not; it knows nothing of the recording.

    # server.yaml                               # benchmark.yaml
    script: vla_eval_server.py                  server: {url: "ws://localhost:8000"}
    args:                                       output_dir: results
      store: runs/smolvla_libero.zarr           benchmarks:
      checkpoint: HuggingFaceVLA/smolvla_libero   - benchmark: vla_eval.benchmarks.libero.benchmark:LIBEROBenchmark
      chunk_size: 10                                episodes_per_task: 5
      port: 8000                                    params: {suite: libero_spatial, send_wrist_image: true,
                                                             send_state: true}

    vla-eval serve --config server.yaml
    vla-eval run --config benchmark.yaml        # --no-docker where the simulator is installed here
    vla-attention analyze runs/smolvla_libero.zarr

vla-eval predicts in a thread of its own and answers from a buffer between policy calls: the replan block stands inside
`predict`, where the policy is called. Several shards share one server: each has its episode, and their calls come one
after another. Where a benchmark runs again, episodes that are in the store are not recorded a second time.
"""

from __future__ import annotations

from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
import torch
from vla_eval.model_servers.predict import PredictModelServer
from vla_eval.model_servers.serve import run_server
from vla_eval.specs import IMAGE_RGB, LANGUAGE, RAW, DimSpec

import vla_attention as va


class RecordingServer(PredictModelServer):
    """A model server that records; a subclass says which policy, and how it is called.

    Args:
        store: the store to write, `NAME.zarr`; one that is there is continued.
        checkpoint: given to `load`, and noted in the store.
        suite: your name for the benchmark.
        chunk_size: executed actions of each policy call.
    """

    def __init__(
        self, store: str, checkpoint: str = "", suite: str = "recorded", chunk_size: int | None = None
    ) -> None:
        super().__init__(chunk_size=chunk_size)
        self.checkpoint = checkpoint
        self.policy, layout, tokenizer = self.load(checkpoint)
        self.run = va.record(
            store,
            self.policy,
            layout=layout,
            tokenizer=tokenizer,
            suite=suite,
            checkpoint=checkpoint,
            untrained=not checkpoint,
            resume=Path(store).exists(),
        ).__enter__()
        self.recorded: dict[str, tuple[ExitStack, Any]] = {}
        self.task_numbers: dict[str, int] = {}

    def load(self, checkpoint: str) -> tuple[Any, va.PolicyLayout, Any]:
        """Return the policy, its layout and its tokenizer (or None)."""
        raise NotImplementedError

    def chunk(self, obs: dict[str, Any]) -> np.ndarray:
        """Call the policy once and return its actions, (horizon, action_dim)."""
        raise NotImplementedError

    def frames(self, obs: dict[str, Any]) -> dict[str, Any]:
        """Return the pictures by the layout's cameras; here: those of the same name."""
        return {name: picture for name, picture in obs["images"].items() if name in self.run.layout.camera_names}

    def predict(self, obs: dict[str, Any], ctx: Any) -> dict[str, Any]:
        """Answer one observation; runs in a thread of vla-eval."""
        _, episode = self.recorded.get(ctx.session_id, (None, None))
        if episode is None:
            return {"actions": self.chunk(obs)}
        with episode.replan(
            env_step=ctx.step,
            frames=self.frames(obs),
            state=obs.get("states", obs.get("state")),
            instruction=obs["task_description"],
        ) as replan:
            replan.actions = self.chunk(obs)
        return {"actions": replan.actions}

    async def on_episode_start(self, config: dict[str, Any], ctx: Any) -> None:
        """Begin an episode of the store."""
        await super().on_episode_start(config, ctx)
        self._leave(ctx, whole=False)
        task = config["task"]
        # Benchmarks number their tasks, or name them only; then they are numbered as they come.
        name = str(task.get("name", "task"))
        number = int(task.get("task_id", self.task_numbers.setdefault(name, len(self.task_numbers))))
        episode = int(task.get("episode_idx", 0))
        if self.run.has(number, episode):
            return
        stack = ExitStack()
        facts = {"task_id": number, "episode_index": episode, "instruction": name}
        self.recorded[ctx.session_id] = stack, stack.enter_context(self.run.episode(**facts))

    async def on_episode_end(self, result: dict[str, Any], ctx: Any) -> None:
        """Store the episode; one whose connection was lost has no result and is dropped."""
        await super().on_episode_end(result, ctx)
        if result and ctx.session_id in self.recorded:
            _, episode = self.recorded[ctx.session_id]
            success = result.get("metrics", {}).get("success")
            episode.success = None if success is None else bool(success)
            episode.num_steps = result.get("steps")
        self._leave(ctx, whole=bool(result))

    def _leave(self, ctx: Any, *, whole: bool) -> None:
        stack, _ = self.recorded.pop(ctx.session_id, (None, None))
        if stack is not None and whole:
            stack.close()
        elif stack is not None:
            stack.__exit__(ConnectionError, ConnectionError("The episode did not end."), None)

    def get_action_spec(self) -> dict[str, DimSpec]:
        """Say what the actions are; vla-eval compares it with the benchmark's."""
        return {"action": RAW}

    def get_observation_spec(self) -> dict[str, DimSpec]:
        """Say what is asked of the benchmark."""
        return {"image": IMAGE_RGB, "language": LANGUAGE}


class SmolVLAServer(RecordingServer):
    """SmolVLA of LeRobot."""

    def load(self, checkpoint: str) -> tuple[Any, va.PolicyLayout, Any]:
        """Return the policy, its layout and its tokenizer, and keep LeRobot's processors."""
        from lerobot.policies.factory import make_pre_post_processors
        from lerobot.policies.smolvla.modeling_smolvla import SmolVLAPolicy

        policy = SmolVLAPolicy.from_pretrained(checkpoint)
        self.before, self.after = make_pre_post_processors(policy.config, pretrained_path=checkpoint)
        return policy, va.layouts.smolvla(policy), policy.model.vlm_with_expert.processor.tokenizer

    def chunk(self, obs: dict[str, Any]) -> np.ndarray:
        """Call the policy; the benchmark's cameras are taken in the order of the policy's."""
        pictures = zip(self.policy.config.image_features, obs["images"].values(), strict=True)
        batch = {name: torch.from_numpy(picture).permute(2, 0, 1)[None] / 255 for name, picture in pictures}
        batch |= {
            "observation.state": torch.from_numpy(np.float32(obs["states"]))[None],
            "task": obs["task_description"],
        }
        with torch.inference_mode():
            return self.after(self.policy.predict_action_chunk(self.before(batch)))[0].cpu().numpy()

    def frames(self, obs: dict[str, Any]) -> dict[str, Any]:
        """Name the pictures as the layout's cameras, in their order."""
        return dict(zip(self.run.layout.camera_names, obs["images"].values(), strict=False))


if __name__ == "__main__":
    run_server(SmolVLAServer)
