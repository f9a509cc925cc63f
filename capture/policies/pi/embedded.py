"""The policy that comes with this package: a small pi0.5 with seeded random weights, which runs on any machine.

It is untrained and solves no task. It has the reference's depth, heads and token layout, and weights scaled such
that its attention has structure: rows are neither uniform nor on one key, and depend on picture, words, noise and time.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from vla_attention.capture.environments.episode_protocol import OPENPI_REPLAN_STEPS
from vla_attention.capture.policies.family import UNTRAINED, UNTRAINED_TINY
from vla_attention.capture.policies.identity import PolicySource
from vla_attention.capture.policies.pi.config import GemmaConfig, PiConfig, SiglipConfig, find_variant
from vla_attention.capture.policies.pi.model import PiModel, expected_shapes, model_from_state
from vla_attention.capture.policies.pi.policy import PiPolicy
from vla_attention.capture.policies.pi.preprocess import ENVIRONMENT_ACTION_DIM, NormStats, Statistics
from vla_attention.capture.policies.pi.processing import STATE_DIM, openpi_processing
from vla_attention.capture.policies.pi.tokenizer import PromptTokenizer
from vla_attention.capture.policies.robot import Robot
from vla_attention.capture.policies.sentencepiece_model import EMBEDDED_TOKENIZER
from vla_attention.capture.policies.weights import Shapes, random_tensor

#: Rows of the token table; the tokenizer has fewer.
_VOCABULARY = 1024

#: Same token layout as openpi's pi05_libero: 3 cameras of 256 keys, 200 text slots, 10 actions.
EMBEDDED_CONFIG = PiConfig(
    paligemma=find_variant("embedded"),
    action_expert=find_variant("embedded_expert"),
    siglip=SiglipConfig(width=64, depth=2, mlp_dim=128, num_heads=4),
    vocab_size=_VOCABULARY,
    action_horizon=10,
    max_token_len=200,
)

#: For tests, runs in milliseconds: 4 patches per camera. Its prompts contain the state, so that tests cover these too.
DUMMY_CONFIG = PiConfig(
    paligemma=GemmaConfig(width=32, depth=3, mlp_dim=48, head_dim=8),
    action_expert=GemmaConfig(width=24, depth=3, mlp_dim=32, head_dim=8),
    siglip=SiglipConfig(width=16, depth=1, mlp_dim=24, num_heads=2, image_size=28),
    vocab_size=_VOCABULARY,
    action_horizon=4,
    max_token_len=96,
    discrete_state_input=True,
    num_denoise_steps=3,
)

#: Made-up ranges of LIBERO's state and actions (not statistics of any data set): the hand above a table in metres, hand
#: pointing down (axis-angle around pi), finger joints; pose changes well inside the controller's -1..1, gripper from
#: open (-1) to closed (1).
_STATE_RANGE = ([-0.4, -0.35, 0.0, 2.4, -1.5, -1.2, 0.0, -0.04], [0.2, 0.35, 1.3, 3.7, 1.5, 0.8, 0.04, 0.0])
_ACTION_RANGE = ([-0.6, -0.6, -0.6, -0.12, -0.15, -0.15, -1.0], [0.6, 0.6, 0.6, 0.12, 0.15, 0.15, 1.0])

#: Standard deviation σ of the logits of the sharpest and the flattest head of a block, for independent keys and
#: queries. Attention then spreads over about exp(-σ²/2) of the keys.
_SHARPEST, _FLATTEST = 2.6, 0.8


def builtin_stats(robot: Robot | None = None) -> NormStats:
    """Return made-up ranges: those of the simulators' arm, or -1 to 1 for every number of a robot of other sizes.

    Mean and spread are those of an even distribution over the range.
    """
    state, actions = _STATE_RANGE, _ACTION_RANGE
    if robot is not None and (robot.state_dim, robot.action_dim) != (STATE_DIM, ENVIRONMENT_ACTION_DIM):
        state, actions = (([-1.0] * dim, [1.0] * dim) for dim in (robot.state_dim, robot.action_dim))

    def statistics(low: list[float], high: list[float]) -> Statistics:
        middle, width = (np.array(low) + high) / 2, np.array(high) - low
        return Statistics(mean=middle.tolist(), std=(width / np.sqrt(12)).tolist(), q01=low, q99=high)

    return NormStats(statistics(*state), statistics(*actions))


def random_weights(config: PiConfig, seed: int) -> dict[str, Tensor]:
    """Return float32 weights of a `PiModel(config)` by tensor name, drawn from `seed` alone."""
    shapes: Shapes = expected_shapes(config)
    state = {}
    for name, shape in shapes.items():
        state[name] = torch.from_numpy(_scaled(name, random_tensor(seed, name, shape), config))
    return state


def _scaled(name: str, normal: np.ndarray, config: PiConfig) -> np.ndarray:
    """Turn standard normal numbers into one tensor of the model, according to its role."""
    if name.endswith("embed_tokens.weight"):
        return normal * np.float32(config.paligemma.width**-0.5)  # scaled up again by sqrt(width) when looked up
    if name.endswith("position_embedding.weight"):
        return normal * np.float32(0.5)
    if "norm" in name and ".dense." not in name:
        is_layer_norm_weight = "vision_tower" in name and name.endswith("weight")
        return np.full_like(normal, 1.0 if is_layer_norm_weight else 0.0)
    if name.endswith("bias"):
        bias = normal * np.float32(0.02)
        if ".dense." in name:
            bias[2 * len(bias) // 3 :] += 0.5  # the gate is 0.5 on average, so that every block has an update
        return bias
    fan_in = int(np.prod(normal.shape[1:]))
    weight = normal * np.float32(fan_in**-0.5)
    if name.endswith("patch_embedding.weight"):
        # Pictures are smooth: with the mean of a filter, patches would differ in brightness only.
        contrast: np.ndarray = weight - np.float32(0.7) * weight.mean(axis=(1, 2, 3), keepdims=True)
        return contrast * np.float32(6.0)
    if "vision_tower" not in name and name.endswith("q_proj.weight"):
        heads = config.paligemma.num_heads
        sharpness = np.geomspace(_FLATTEST, _SHARPEST, heads, dtype=np.float32)
        return weight * np.repeat(sharpness, normal.shape[0] // heads)[:, None]
    if ".dense." in name:
        return weight * np.float32(0.6)
    if name == "action_out_proj.weight":
        return weight * np.float32(0.6)  # keeps actions within about twice the range of the statistics
    return weight


def build_random_model(config: PiConfig, seed: int, device: str | torch.device = "cpu") -> PiModel:
    """Build a model with `random_weights`."""
    return model_from_state(config, random_weights(config, seed), device=device)


def _random_policy(
    name: str,
    config: PiConfig,
    seed: int,
    device: str | torch.device,
    robot: Robot | None,
    replan_steps: int = OPENPI_REPLAN_STEPS,
) -> PiPolicy:
    return PiPolicy(
        build_random_model(config, seed, device),
        PromptTokenizer(EMBEDDED_TOKENIZER),
        openpi_processing(config, builtin_stats(robot), robot, replan_steps),
        PolicySource(name=name, checkpoint=f"random weights, seed {seed}", checkpoint_format="seeded", untrained=True),
    )


def embedded_policy(seed: int = 0, device: str | torch.device = "cpu", robot: Robot | None = None) -> PiPolicy:
    """Build the untrained policy; the seed draws its weights. robot: of a data set; None: the simulators' arm."""
    return _random_policy(UNTRAINED, EMBEDDED_CONFIG, seed, device, robot)


def dummy_policy(seed: int = 0, device: str | torch.device = "cpu", robot: Robot | None = None) -> PiPolicy:
    """Build the policy of test size; all four actions of a chunk are executed."""
    return _random_policy(UNTRAINED_TINY, DUMMY_CONFIG, seed, device, robot, DUMMY_CONFIG.action_horizon)
