"""Batches for training: pictures, prompts, and what the losses compare with."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from examples.cubes_policy.dataset import Control, Samples, pictures_of, seen_instructions, task_weights
from examples.cubes_policy.network import CAMERAS
from examples.cubes_policy.vocabulary import NUMBERS, number_piece
from vla_attention.capture.policies.pi.config import PiConfig
from vla_attention.capture.policies.pi.preprocess import Statistics, pad_to
from vla_attention.capture.policies.pi.tokenizer import PromptTokenizer, digitise_state
from vla_attention.schemas.layout import Role

#: Pairs of noise and flow time that share one pass through the vision-language model.
PAIRS = 4

#: Largest change of a picture's contrast and brightness, as parts of its range.
_JITTER = 0.05
#: Largest change of a digit of the state.
_DIGIT_JITTER = 2
#: Spread of the heat target around a cube's centre, in patches.
_HEAT_SPREAD = 0.6
#: Positions are learnt in decimetres, so that they are about as large as the other targets.
_POSITION_UNIT = 0.1


@dataclass(frozen=True)
class Batch:
    """One batch on the CPU.

    images: per camera (batch, 3, 64, 64) in -1..1. tokens, token_mask: (batch, text). actions: (batch, horizon, action
    dim). noise: (batch, pair, horizon, action dim); times: (batch, pair), 1 = noise. heat: (batch, camera, 2, patch),
    the distribution around the named cube and around the destination; has_heat: (batch, camera, 2). positions: (batch,
    4, 3) in decimetres, the named cube from the gripper and from the origin, then the destination's; has_position:
    (batch, 4).
    """

    images: dict[str, Tensor]
    tokens: Tensor
    token_mask: Tensor
    actions: Tensor
    noise: Tensor
    times: Tensor
    heat: Tensor
    has_heat: Tensor
    positions: Tensor
    has_position: Tensor


class Prompts:
    """Tokens of every task's prompt, in which the digits of the state are then written."""

    def __init__(self, tokenizer: PromptTokenizer, instructions: Sequence[str], config: PiConfig):
        self.number_ids = number_ids(tokenizer)
        tokenized = [
            tokenizer.tokenize(text, max_token_len=config.max_token_len, state=np.zeros(8)) for text in instructions
        ]
        longest = max(int(prompt.mask.sum()) for prompt in tokenized)
        # Slots that no prompt fills have no influence; leaving them out saves time.
        self._ids = np.stack([prompt.ids[:longest] for prompt in tokenized])
        self._mask = np.stack([prompt.mask[:longest] for prompt in tokenized])
        self._slots = np.stack([np.flatnonzero(prompt.roles == Role.STATE) for prompt in tokenized])

    def fill(self, task: NDArray[np.integer], bins: NDArray[np.integer]) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
        """Return tokens and mask (batch, text) for tasks (batch,) and bins of the state (batch, 8), -1..255."""
        ids = self._ids[task]
        np.put_along_axis(ids, self._slots[task], self.number_ids[bins - NUMBERS.start], axis=1)
        return ids, self._mask[task]


def number_ids(tokenizer: PromptTokenizer) -> NDArray[np.int64]:
    """Return the token of each of `NUMBERS`, (number,)."""
    encoded = tokenizer.model.encode("".join(f" {number}" for number in NUMBERS))
    if [token.piece for token in encoded] != [number_piece(number) for number in NUMBERS]:
        raise ValueError("the tokenizer has no token of its own for every number")
    return np.array([token.id for token in encoded], dtype=np.int64)


class Batches:
    """Draws batches from some samples of the demonstrations, under a control.

    chosen: indices of the samples that may be drawn. jitter: whether pictures and digits are changed a little.
    """

    def __init__(
        self,
        samples: Samples,
        chosen: NDArray[np.int64],
        instructions: tuple[str, ...],
        tokenizer: PromptTokenizer,
        config: PiConfig,
        state_statistics: Statistics,
        control: Control,
        *,
        batch_size: int,
        seed: int,
        jitter: bool,
    ):
        self._samples, self._chosen, self._instructions, self._config = samples, chosen, instructions, config
        self._control, self._batch_size, self._seed, self._jitter = control, batch_size, seed, jitter
        self._weights = task_weights(samples.task[chosen])
        self._prompts = Prompts(tokenizer, seen_instructions(instructions, control), config)
        self._bins = digitise_state(state_statistics.normaliser("quantile").normalise(samples.state))

    def draw(self, step: int) -> Batch:
        """Return the batch of a step."""
        rng = np.random.Generator(np.random.Philox(np.random.SeedSequence([self._seed, step])))
        drawn = rng.choice(self._chosen, size=self._batch_size, p=self._weights)
        others = rng.choice(self._chosen, size=self._batch_size)
        return self._batch(drawn, others, rng)

    def _batch(self, drawn: NDArray[np.int64], others: NDArray[np.int64], rng: np.random.Generator) -> Batch:
        samples, config = self._samples, self._config
        pictures = pictures_of(samples, drawn, others, self._instructions, self._control)
        scaled = np.ascontiguousarray(pictures.transpose(1, 0, 4, 2, 3)).astype(np.float32) / 255.0 * 2.0 - 1.0
        bins = self._bins[drawn]
        if self._jitter:
            size = (len(CAMERAS), len(drawn), 1, 1, 1)
            scaled *= 1.0 + rng.uniform(-_JITTER, _JITTER, size).astype(np.float32)
            scaled += rng.uniform(-2 * _JITTER, 2 * _JITTER, size).astype(np.float32)
            moved = bins + rng.integers(-_DIGIT_JITTER, _DIGIT_JITTER, bins.shape, endpoint=True)
            bins = np.clip(moved, NUMBERS.start, NUMBERS.stop - 1)
        ids, mask = self._prompts.fill(samples.task[drawn], bins)
        heat, has_heat = heat_targets(
            samples.cube_pixels[drawn], samples.target[drawn], samples.destination[drawn], config.siglip.grid
        )
        positions, has_position = position_targets(
            samples.cube_positions[drawn], samples.eef[drawn], samples.target[drawn], samples.destination[drawn]
        )
        pairs = (len(drawn), PAIRS)
        noise = rng.standard_normal((*pairs, config.action_horizon, config.action_dim), dtype=np.float32)
        times = (rng.beta(1.5, 1.0, pairs) * 0.999 + 0.001).astype(np.float32)
        return Batch(
            images={camera: torch.from_numpy(scaled[i]) for i, camera in enumerate(CAMERAS)},
            tokens=torch.from_numpy(ids),
            token_mask=torch.from_numpy(mask),
            actions=torch.from_numpy(pad_to(samples.actions[drawn], config.action_dim).astype(np.float32)),
            noise=torch.from_numpy(noise),
            times=torch.from_numpy(times),
            heat=torch.from_numpy(heat),
            has_heat=torch.from_numpy(has_heat),
            positions=torch.from_numpy(positions),
            has_position=torch.from_numpy(has_position),
        )


def _of_cube(values: np.ndarray, cube: NDArray[np.integer]) -> np.ndarray:
    """Return values[i, ..., cube[i], :] of (batch, ..., cube, dim); NaN where cube is -1."""
    chosen = np.take_along_axis(values, cube.clip(0).reshape(-1, *[1] * (values.ndim - 1)).astype(np.int64), axis=-2)
    picked: np.ndarray = chosen[..., 0, :]
    picked[cube < 0] = np.nan
    return picked


def heat_targets(
    cube_pixels: NDArray[np.float32], target: NDArray[np.integer], destination: NDArray[np.integer], grid: int
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Return distributions over patches (batch, camera, 2, patch) around two cubes, and which exist.

    cube_pixels: (batch, camera, cube, 2), row and column in [0, 1]. A Gaussian around the centre, on the patches'
    centres.
    """
    places = np.stack([_of_cube(cube_pixels, target), _of_cube(cube_pixels, destination)], axis=2)
    inside = np.isfinite(places) & (places >= 0.0) & (places <= 1.0)
    exists = np.asarray(inside.all(axis=-1))
    centres = (np.arange(grid) + 0.5) / grid
    distance = (np.where(exists[..., None], places, 0.5)[..., None] - centres) * grid  # (batch, camera, 2, axis, grid)
    weight = np.exp(-0.5 * (distance / _HEAT_SPREAD) ** 2)
    both = (weight[..., 0, :, None] * weight[..., 1, None, :]).reshape(*exists.shape, grid * grid)
    return (both / both.sum(axis=-1, keepdims=True)).astype(np.float32), exists


def position_targets(
    cube_positions: NDArray[np.float32],
    eef: NDArray[np.float32],
    target: NDArray[np.integer],
    destination: NDArray[np.integer],
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Return positions in decimetres (batch, 4, 3) and which exist, (batch, 4).

    The named cube's from the gripper and from the world's origin, then the destination's.
    """
    cubes = [_of_cube(cube_positions, target), _of_cube(cube_positions, destination)]
    positions = np.stack([place for cube in cubes for place in (cube - eef, cube)], axis=1) / _POSITION_UNIT
    exists = np.asarray(np.isfinite(positions).all(axis=-1))
    return np.where(exists[..., None], positions, 0.0).astype(np.float32), exists
