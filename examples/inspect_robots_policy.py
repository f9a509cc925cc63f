"""Record attention inside Inspect Robots: a policy around yours that stores every policy call of the trials it acts in.

Copy this file, wrap your policy, and evaluate it as before; it has to compute in this process, not behind a server.

    import inspect_robots
    import vla_attention as va
    from inspect_robots_policy import RecordedPolicy

    with va.record("runs/arm.zarr", policy.network, layout=va.layouts.smolvla(policy.network), suite="arm") as run:
        inspect_robots.eval(task, RecordedPolicy(policy, run), embodiment)

Scenes of one instruction are one task, and its trials are numbered as they come. A trial that ends with an error is
dropped. Where an evaluation runs again into the same store (`resume=True`), its trials are not recorded a second time.
"""

from __future__ import annotations

from contextlib import ExitStack
from typing import Any

import numpy as np
from inspect_robots import OPERATOR_END, ActionChunk, Observation, Policy, Scene, TrialRecord, is_affirmative_verdict


class RecordedPolicy:
    """A policy that acts as another one, and records.

    Args:
        policy: the policy; its hooks (`bind`, `transcript` ...) are called as without recording.
        run: what `va.record` gave for its network.
    """

    def __init__(self, policy: Policy, run: Any) -> None:
        self.policy, self.run = policy, run
        self.episode: Any = None
        self.instruction = ""
        self._stack: ExitStack | None = None
        self._trials: dict[str, int] = {}

    def __getattr__(self, name: str) -> Any:
        """Return the policy's own: spaces, configuration and optional hooks."""
        return getattr(self.policy, name)

    def frames(self, observation: Observation) -> dict[str, Any]:
        """Return the pictures by the layout's cameras; here: those of the same name."""
        return {name: picture for name, picture in observation.images.items() if name in self.run.layout.camera_names}

    def state(self, observation: Observation) -> np.ndarray | None:
        """Return the state as one array; here: all of it, in the embodiment's order."""
        parts = [np.ravel(part) for part in observation.state.values()]
        return np.concatenate(parts) if parts else None

    def success(self, record: TrialRecord) -> bool | None:
        """Return the outcome of a trial: what its operator or grader says, else how it ended; None: nobody says."""
        if record.operator_judgement is not None:
            return is_affirmative_verdict(record.operator_judgement)
        return None if record.termination_reason == OPERATOR_END else record.termination_reason == "success"

    def reset(self, scene: Scene) -> None:
        """Begin a trial, and an episode of the store."""
        self._leave(whole=False)
        self.policy.reset(scene)
        self.instruction = scene.instruction
        trial = self._trials.get(scene.instruction, 0)
        self._trials[scene.instruction] = trial + 1
        facts = {"task_id": list(self._trials).index(scene.instruction), "episode_index": trial}
        if not self.run.has(**facts):
            self._stack = ExitStack()
            self.episode = self._stack.enter_context(self.run.episode(**facts, instruction=scene.instruction))

    def act(self, observation: Observation) -> ActionChunk:
        """Call the policy."""
        if self.episode is None:
            return self.policy.act(observation)
        with self.episode.replan(
            env_step=observation.extra["env_step"],
            frames=self.frames(observation),
            state=self.state(observation),
            instruction=observation.instruction or self.instruction,
        ) as replan:
            chunk = self.policy.act(observation)
            replan.actions = np.stack([action.data for action in chunk.actions])
        return chunk

    def on_trial_end(self, record: TrialRecord, log_dir: str, run_id: str) -> None:
        """Store the episode; a trial that was cancelled or ended with an error is dropped."""
        if callable(hook := getattr(self.policy, "on_trial_end", None)):
            hook(record, log_dir, run_id)
        if self.episode is not None:
            self.episode.success = self.success(record)
            self.episode.num_steps = len(record.steps)
        self._leave(whole=record.status == "success")

    def _leave(self, *, whole: bool) -> None:
        stack, self._stack, self.episode = self._stack, None, None
        if stack is not None and whole:
            stack.close()
        elif stack is not None:
            stack.__exit__(InterruptedError, InterruptedError("The trial did not end."), None)
