"""An environment for `lerobot-eval --env.discover_packages_path=tests.policies.noise_environment --env.type=noise`."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import gymnasium
import numpy as np
from lerobot.envs.configs import EnvConfig

from tests.policies import lerobot_models as models
from tests.policies.word_tokenizer import INSTRUCTION

ENDS = (7, 12)


class NoiseEnvironment(gymnasium.Env[Any, Any]):
    """Pictures of noise; ends after a number of steps, the first environment in success.

    number: 0 or 1; None: whether the seed is odd.
    """

    metadata = {"render_fps": 10, "render_modes": ["rgb_array"]}  # noqa: RUF012
    task = task_description = INSTRUCTION
    render_mode = "rgb_array"
    _max_episode_steps = 20

    def __init__(self, number: int | None = None) -> None:
        pictures = {name: gymnasium.spaces.Box(0, 255, (48, 64, 3), dtype=np.uint8) for name in models.CAMERAS}
        self.observation_space = gymnasium.spaces.Dict(
            {
                "pixels": gymnasium.spaces.Dict(pictures),
                "agent_pos": gymnasium.spaces.Box(-1, 1, (models.STATE_DIM,), dtype=np.float64),
            }
        )
        self.action_space = gymnasium.spaces.Box(-1, 1, (models.ACTION_DIM,), dtype=np.float32)
        self.given, self.number, self.count = number, number or 0, 0

    def _observation(self) -> dict[str, Any]:
        numbers = np.random.default_rng([self.number, self.count])
        return {
            "pixels": {name: numbers.integers(0, 255, (48, 64, 3), dtype=np.uint8) for name in models.CAMERAS},
            "agent_pos": np.full(models.STATE_DIM, self.count / 20),
        }

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        self.count = 0
        if self.given is None and seed is not None:
            self.number = seed % 2
        return self._observation(), {"is_success": False}

    def step(self, action: Any) -> Any:
        self.count += 1
        ended = self.count >= ENDS[self.number]
        success = {"is_success": bool(ended and self.number == 0)}
        # As LeRobot's own environments say it, which also reset themselves.
        return self._observation(), 0.0, ended, False, {**success, **({"final_info": success} if ended else {})}

    def render(self) -> Any:
        return self._observation()["pixels"][models.CAMERAS[0]]


gymnasium.register("gym_noise/Noise-v0", NoiseEnvironment)


@EnvConfig.register_subclass("noise")
@dataclass
class NoiseConfig(EnvConfig):
    """What lerobot-eval makes of it: the features of a policy with two cameras and a state."""

    task: str | None = "Noise-v0"
    features: dict[str, Any] = field(default_factory=models.environment_features)
    features_map: dict[str, str] = field(default_factory=lambda: {name: name for name in models.environment_features()})

    @property
    def gym_kwargs(self) -> dict[str, Any]:
        """Nothing: two seeds are two environments."""
        return {}
