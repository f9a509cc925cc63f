"""lerobot-eval's loop with a recorder around the policy.

lerobot-eval runs a batch of environments with one policy call for all of them, and the policy answers from a queue most
of the time: `run.episodes` splits the call by row, and blocks in which no attention ran are dropped. Rows whose episode
has ended are not recorded. Change `layout_of` and `pictures_of` where your policy is another.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from typing import Any

import numpy as np
from lerobot.scripts import lerobot_eval

import vla_attention as va

PREFIX = "observation.images."
#: LeRobot's name of a policy -> its layout.
LAYOUTS = {
    "act": va.layouts.act,
    "evo1": va.layouts.evo1,
    "pi0": va.layouts.pi0_pytorch,
    "pi05": va.layouts.pi0_pytorch,
    "pi0_fast": va.layouts.pi0_fast,
    "smolvla": va.layouts.smolvla,
    "xvla": va.layouts.xvla,
}


def layout_of(policy: Any) -> va.PolicyLayout:
    """Return the layout of one of LeRobot's policies."""
    if policy.name not in LAYOUTS:
        raise va.UserError(
            f"No layout is known for the policy '{policy.name}' inside lerobot-eval (known: {', '.join(LAYOUTS)}). "
            "Add it to LAYOUTS in recorder.py; docs/my-policy.md says how to write one."
        )
    return LAYOUTS[policy.name](policy)


def tokenizer_of(preprocessor: Any, policy: Any) -> Any:
    """Return the tokenizer of the policy's preprocessor or of one of its modules (EVO-1), or None."""
    found = [getattr(step, "input_tokenizer", None) for step in getattr(preprocessor, "steps", ())]
    found += [getattr(module, "tokenizer", None) for module in policy.modules()]
    return next((tokenizer for tokenizer in found if tokenizer is not None), None)


def pictures_of(observation: dict[str, Any], preprocessor: Any, row: int) -> dict[str, Any]:
    """Return one environment's pictures, (3, height, width) from 0 to 1, by the policy's names of the cameras."""
    steps = getattr(preprocessor, "steps", ())
    names = next((step.rename_map for step in steps if getattr(step, "rename_map", None)), {})
    return {
        names.get(name, name).removeprefix(PREFIX): value[row]
        for name, value in observation.items()
        if name.startswith(PREFIX)
    }


def turns_pictures(env_preprocessor: Any) -> bool:
    """Return whether left and right are exchanged: LeRobot turns LIBERO's pictures, upside down, by 180 degrees."""
    return any(type(step).__name__ == "LiberoProcessorStep" for step in getattr(env_preprocessor, "steps", ()))


def instructions_of(env: Any) -> list[str]:
    """Return each environment's instruction, from where lerobot-eval has it."""
    for name in ("task_description", "task"):
        with suppress(AttributeError, NotImplementedError):
            return [str(text) for text in env.call(name)]
    return [""] * env.num_envs


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
        preprocessor, observed = arguments.pop("preprocessor"), {}
        if self.run is None:
            tokenizer = tokenizer_of(preprocessor, policy)
            layout = layout_of(policy)
            turned = layout.camera_names if turns_pictures(arguments.get("env_preprocessor")) else ()
            settings = {"layout": layout, "tokenizer": tokenizer, "mirrored": turned, **self.settings}
            self.run = va.record(self.store, policy, **settings).__enter__()
        first, self.episodes = self.episodes, self.episodes + env.num_envs
        facts = [
            {"task_id": self.task, "episode_index": first + row, "instruction": text, "seed": seeds and seeds[row]}
            for row, text in enumerate(instructions_of(env))
        ]
        running = np.ones(env.num_envs, dtype=bool)
        steps, successes = np.zeros(env.num_envs, dtype=int), np.zeros(env.num_envs, dtype=bool)
        select, step = policy.select_action, env.step

        def preprocess(observation: dict[str, Any]) -> Any:
            # Pictures and state are stored as they are here: not normalised.
            observed.update(observation)
            return preprocessor(observation)

        def select_action(batch: dict[str, Any], **named: Any) -> Any:
            given = {"frames": [pictures_of(observed, preprocessor, row) for row in range(env.num_envs)]}
            if "observation.state" in observed:
                given["state"] = list(observed["observation.state"])
            with episodes.replan(env_step=int(steps.max()), active=running.tolist(), **given):
                return select(batch, **named)

        def count(actions: Any) -> Any:
            result = step(actions)
            _, _, ended, cut, info = result
            steps[running] += 1
            final = info.get("final_info", info).get("is_success")
            if final is not None:
                successes[running] |= np.asarray(final, dtype=bool)[running]
            running[np.asarray(ended) | np.asarray(cut)] = False
            return result

        with self.run.episodes(facts) as episodes:
            policy.select_action, env.step = select_action, count
            try:
                result = self.rollout(env, policy, seeds=seeds, preprocessor=preprocess, **arguments)
            finally:
                del policy.select_action, env.step
            for episode, success, number in zip(episodes, successes, steps, strict=True):
                episode.success, episode.num_steps = bool(success), int(number)
        return result
