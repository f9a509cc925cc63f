"""Record attention inside lerobot-eval: the same command line, with a store in front.

    python lerobot_eval_recorded.py runs/smolvla_libero.zarr \\
        --policy.path=HuggingFaceVLA/smolvla_libero --env.type=libero --env.task=libero_spatial \\
        --eval.n_episodes=10 --eval.batch_size=5
    vla-attention analyze runs/smolvla_libero.zarr

lerobot-eval runs a batch of environments with one policy call for all of them, and the policy answers from a queue most
of the time: `run.episodes` splits the call by row, and blocks in which no attention ran are dropped. Rows whose episode
has ended are not recorded. Copy this file; change `layout_of` and `pictures_of` where your policy is another.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import Any

import numpy as np
from lerobot.scripts import lerobot_eval

import vla_attention as va

PREFIX = "observation.images."


def layout_of(policy: Any) -> va.PolicyLayout:
    """Return the policy's layout; the layouts that are shipped have LeRobot's names."""
    return getattr(va.layouts, policy.name)(policy)


def tokenizer_of(preprocessor: Any) -> Any:
    """Return the tokenizer of the policy's preprocessor, or None."""
    steps = getattr(preprocessor, "steps", ())
    return next((step.input_tokenizer for step in steps if getattr(step, "input_tokenizer", None) is not None), None)


def pictures_of(batch: dict[str, Any], row: int) -> dict[str, Any]:
    """Return one environment's pictures by camera, (3, height, width) from 0 to 1."""
    return {name.removeprefix(PREFIX): value[row] for name, value in batch.items() if name.startswith(PREFIX)}


class Recorder:
    """Stands in the place of lerobot-eval's `rollout` and `run_one`, and calls them.

    Args:
        store: the store to write, `NAME.zarr`.
        settings: further arguments of `va.record`.
    """

    def __init__(self, store: str, **settings: Any) -> None:
        self.store, self.settings = store, settings
        self.run: Any = None
        self.rollout: Callable[..., Any] = lerobot_eval.rollout
        self.run_one: Callable[..., Any] = lerobot_eval.run_one
        self.tasks: dict[tuple[str, int], int] = {}
        self.task, self.episodes = 0, 0

    def install(self) -> None:
        """Let lerobot-eval call this."""
        lerobot_eval.rollout, lerobot_eval.run_one = self.recorded_rollout, self.recorded_task

    def recorded_task(self, task_group: str, task_id: int, env: Any, **arguments: Any) -> Any:
        """Evaluate one task; note its number."""
        self.task = self.tasks.setdefault((task_group, task_id), len(self.tasks))
        self.episodes = 0
        return self.run_one(task_group, task_id, env, **arguments)

    def recorded_rollout(self, env: Any, policy: Any, *, seeds: list[int] | None = None, **arguments: Any) -> Any:
        """Run a batch of environments once, and store an episode of each."""
        if self.run is None:
            tokenizer = tokenizer_of(arguments.get("preprocessor"))
            settings = {"layout": layout_of(policy), "tokenizer": tokenizer, **self.settings}
            self.run = va.record(self.store, policy, **settings).__enter__()
        instructions = [str(text) for text in env.call("task_description")]
        first, self.episodes = self.episodes, self.episodes + env.num_envs
        facts = [
            {"task_id": self.task, "episode_index": first + row, "instruction": text, "seed": seeds and seeds[row]}
            for row, text in enumerate(instructions)
        ]
        running = np.ones(env.num_envs, dtype=bool)
        steps, successes = np.zeros(env.num_envs, dtype=int), np.zeros(env.num_envs, dtype=bool)
        select, step = policy.select_action, env.step

        def select_action(batch: dict[str, Any], **named: Any) -> Any:
            given = {
                "frames": [pictures_of(batch, row) for row in range(env.num_envs)],
                "state": list(batch["observation.state"]),
            }
            with episodes.replan(env_step=int(steps.max()), active=running.tolist(), **given):
                return select(batch, **named)

        def count(actions: Any) -> Any:
            result = step(actions)
            _, _, ended, cut, info = result
            steps[running] += 1
            final = info.get("final_info", {}).get("is_success")
            if final is not None:
                successes[running] |= np.asarray(final, dtype=bool)[running]
            running[np.asarray(ended) | np.asarray(cut)] = False
            return result

        with self.run.episodes(facts) as episodes:
            policy.select_action, env.step = select_action, count
            try:
                result = self.rollout(env, policy, seeds=seeds, **arguments)
            finally:
                del policy.select_action, env.step
            for episode, success, number in zip(episodes, successes, steps, strict=True):
                episode.success, episode.num_steps = bool(success), int(number)
        return result


if __name__ == "__main__":
    Recorder(sys.argv.pop(1)).install()
    lerobot_eval.main()
