"""Train the small policy on demonstrations, from a seed, in a folder from which a killed training goes on."""

from __future__ import annotations

import csv
import json
import math
import os
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from examples.cubes_policy.batches import Batches, number_ids
from examples.cubes_policy.dataset import Control, Demonstrations, new_folder, split_scenes, usable_samples
from examples.cubes_policy.network import initial_model, small_config
from examples.cubes_policy.objectives import WEIGHTS, Heads, losses, total
from examples.cubes_policy.vocabulary import make_tokenizer
from vla_attention.capture.environments.cubes.tasks import CUBE_TASKS
from vla_attention.capture.policies.pi.config import PiConfig
from vla_attention.capture.policies.pi.model import PiModel
from vla_attention.capture.policies.pi.preprocess import Statistics
from vla_attention.capture.policies.pi.tokenizer import PromptTokenizer
from vla_attention.capture.torch_files import load_torch
from vla_attention.schemas.checked_files import read_object
from vla_attention.schemas.errors import BadArgument, UserError

CHECKPOINT, TOKENIZER, SETTINGS, LOG = "checkpoint.pt", "tokenizer.model", "settings.json", "log.csv"

PEAK_RATE, LAST_RATE, WARM_UP = 1e-3, 3e-5, 50
BETAS, WEIGHT_DECAY, CLIP = (0.9, 0.95), 0.01, 1.0
EMA_DECAY = 0.998
#: Seeds of the streams that are drawn from one seed of the training.
_HEADS, _HELD_OUT = 1, 2
#: Batches on which the losses of the held-out scenes are measured; always the same.
_HELD_OUT_BATCHES = 4


class UnusableTraining(UserError, ValueError):
    """The folder has no training to go on with, or another one than was asked for."""


@dataclass(frozen=True)
class TrainingSettings:
    """What a training depends on, besides the demonstrations.

    steps: of the schedule. num_tasks: the first tasks of the suite, which are learnt. log_every, evaluate_every: steps
    between two lines of the log, and between two measurements on held-out scenes. checkpoint_minutes: between two
    checkpoints.
    """

    steps: int
    seed: int = 0
    control: Control = "words"
    num_tasks: int = len(CUBE_TASKS)
    batch_size: int = 64
    log_every: int = 20
    evaluate_every: int = 200
    checkpoint_minutes: float = 3.0

    def __post_init__(self) -> None:
        if self.seed < 0:
            raise BadArgument(f"seed is {self.seed}; it must be at least 0.")
        for name in ("steps", "num_tasks", "batch_size", "log_every", "evaluate_every"):
            if getattr(self, name) < 1:
                raise BadArgument(f"{name} is {getattr(self, name)}; it must be at least 1.")

    @property
    def identity(self) -> dict[str, Any]:
        """What must be equal when a training goes on; the number of steps may be another one."""
        return {name: getattr(self, name) for name in ("seed", "control", "num_tasks", "batch_size")}


def learning_rate(step: int, steps: int) -> float:
    """Return the rate of a step: linear warm-up to `PEAK_RATE`, then a cosine to `LAST_RATE`."""
    warm_up = min(WARM_UP, max(1, steps // 10))
    if step < warm_up:
        return PEAK_RATE * (step + 1) / warm_up
    progress = min(1.0, (step - warm_up) / max(1, steps - warm_up))
    return LAST_RATE + 0.5 * (PEAK_RATE - LAST_RATE) * (1.0 + math.cos(math.pi * progress))


def state_statistics(state: np.ndarray) -> Statistics:
    """Return the statistics of the states (sample, 8) by which they are normalised."""
    state = state.astype(np.float64)
    low, high = np.quantile(state, (0.01, 0.99), axis=0)
    mean, std = state.mean(axis=0), state.std(axis=0)
    return Statistics(mean.tolist(), std.tolist(), low.tolist(), high.tolist())


class Training:
    """A training in memory: the model, its moving average, the heads and the optimiser."""

    def __init__(self, settings: TrainingSettings, config: PiConfig, number_tokens: Iterable[int]):
        self.settings, self.config = settings, config
        self.step, self.seconds = 0, 0.0
        self.model: PiModel = initial_model(config, list(number_tokens), settings.seed)
        self.heads = Heads(config.paligemma.width, settings.seed + _HEADS)
        self.average: PiModel = initial_model(config, list(number_tokens), settings.seed).requires_grad_(False)
        self.average_heads = Heads(config.paligemma.width, settings.seed + _HEADS).requires_grad_(False)
        self._parameters: list[Tensor] = [*self.model.parameters(), *self.heads.parameters()]
        self._averages: list[Tensor] = [*self.average.parameters(), *self.average_heads.parameters()]
        self.optimiser = torch.optim.AdamW(
            _decay_groups(self.model, self.heads), lr=PEAK_RATE, betas=BETAS, weight_decay=WEIGHT_DECAY, fused=True
        )

    def advance(self, batches: Batches) -> dict[str, float]:
        """Take one step; returns the parts of its loss."""
        rate = learning_rate(self.step, self.settings.steps)
        for group in self.optimiser.param_groups:
            group["lr"] = rate
        batch = batches.draw(self.step)
        with torch.autocast("cpu", dtype=torch.bfloat16):
            parts = losses(self.model, self.heads, batch)
            loss = total(parts)
        self.optimiser.zero_grad(set_to_none=True)
        loss.backward()  # type: ignore[no-untyped-call]
        nn.utils.clip_grad_norm_(self._parameters, CLIP)
        self.optimiser.step()
        self.step += 1
        # Early weights are far from good ones, so the average forgets them faster.
        decay = min(EMA_DECAY, (1.0 + self.step) / (10.0 + self.step))
        with torch.no_grad():
            torch._foreach_lerp_(self._averages, self._parameters, 1.0 - decay)
        return {"total": float(loss.detach()), **{name: float(part.detach()) for name, part in parts.items()}}

    @torch.no_grad()
    def measure(self, batches: Batches) -> dict[str, float]:
        """Return the averaged weights' losses on some batches, always the same."""
        found = []
        for number in range(_HELD_OUT_BATCHES):
            with torch.autocast("cpu", dtype=torch.bfloat16):
                parts = losses(self.average, self.average_heads, batches.draw(number))
            found.append({"total": float(total(parts)), **{name: float(part) for name, part in parts.items()}})
        return {name: float(np.mean([one[name] for one in found])) for name in found[0]}

    def state(self) -> dict[str, Any]:
        """Return everything that a continuation needs, for `torch.save`."""
        return {"step": self.step, "seconds": self.seconds} | {
            part: getattr(self, part).state_dict() for part in _PARTS
        }

    def load(self, state: dict[str, Any]) -> None:
        """Go back to a `state`."""
        self.step, self.seconds = state["step"], state["seconds"]
        for part in _PARTS:
            getattr(self, part).load_state_dict(state[part])


#: What of a training is in its checkpoint, besides the numbers of steps and seconds.
_PARTS = ("model", "heads", "average", "average_heads", "optimiser")


def _decay_groups(*modules: nn.Module) -> list[dict[str, Any]]:
    """Return the optimiser's groups: matrices decay; biases, norms and embeddings do not."""
    named = [(name, parameter) for module in modules for name, parameter in module.named_parameters()]
    matrices = [p for name, p in named if p.ndim >= 2 and "embed" not in name]
    others = [p for name, p in named if not (p.ndim >= 2 and "embed" not in name)]
    return [{"params": matrices}, {"params": others, "weight_decay": 0.0}]


def train(
    demonstrations: Demonstrations,
    instructions: tuple[str, ...],
    output: Path,
    settings: TrainingSettings,
    *,
    resume: bool = False,
    say: Callable[[str], None] = print,
    stop_at: int | None = None,
) -> Training:
    """Train in the folder `output`: checkpoints, log.csv and what `export` needs.

    instructions: of each task. resume: go on from the folder's checkpoint, if there is one. stop_at: end before this
    step, as a kill would after a checkpoint.
    """
    new_folder(output, "training")
    tokenizer_file = output / TOKENIZER
    tokenizer_file.write_bytes(make_tokenizer())
    tokenizer = PromptTokenizer(tokenizer_file)
    config = small_config(tokenizer.vocab_size)
    samples = demonstrations.samples
    usable = usable_samples(samples, settings.control, settings.num_tasks)
    training_part, held_out = (part[usable[part]] for part in split_scenes(samples))
    if not len(training_part) or not len(held_out):
        raise BadArgument(
            f"The control '{settings.control}' can use {len(training_part)} samples for training and {len(held_out)} "
            "of scenes that are held out; record more demonstrations."
        )
    statistics = state_statistics(samples.state[training_part])
    facts = {
        **settings.identity,
        "instructions": list(instructions),
        "demonstrations": demonstrations.digest,
        "samples": {"training": len(training_part), "held_out": len(held_out)},
        "state": {name: getattr(statistics, name) for name in ("mean", "std", "q01", "q99")},
    }
    training = Training(settings, config, number_ids(tokenizer).tolist())
    _begin(training, output, facts, resume=resume)
    say(
        f"trains {sum(parameter.numel() for parameter in training.model.parameters()):,} parameters on "
        f"{len(training_part):,} samples from step {training.step} to step {settings.steps}, with {len(held_out):,} "
        f"samples of other scenes held out; a line every {settings.log_every} steps"
    )
    drawn, kept_out = (
        Batches(
            samples, part, instructions, tokenizer, config, statistics, settings.control,
            batch_size=settings.batch_size, seed=seed, jitter=jitter,
        )
        for part, seed, jitter in ((training_part, settings.seed, True), (held_out, _HELD_OUT, False))
    )  # fmt: skip
    saved_at, before, collected = time.monotonic(), time.monotonic() - training.seconds, []
    last = min(settings.steps, stop_at or settings.steps)
    while training.step < last:
        collected.append(training.advance(drawn))
        step, now = training.step, time.monotonic()
        training.seconds = now - before
        if step % settings.log_every == 0 or step == last:
            row: dict[str, float] = {"step": step, "seconds": round(training.seconds, 1)}
            row |= {
                f"train_{name}": round(float(np.mean([one[name] for one in collected])), 5) for name in collected[0]
            }
            if step % settings.evaluate_every == 0 or step == last:
                measured = training.measure(kept_out)
                row |= {f"held_out_{name}": round(value, 5) for name, value in measured.items()}
            collected.clear()
            with (output / LOG).open("a", newline="", encoding="utf-8") as file:
                csv.DictWriter(file, _COLUMNS).writerow(row)
            say(", ".join(f"{name} {value}" for name, value in row.items()))
        if now - saved_at >= 60.0 * settings.checkpoint_minutes or step == last:
            save(training, output)
            saved_at = time.monotonic()
    return training


_COLUMNS = ("step", "seconds", *(f"{of}_{part}" for of in ("train", "held_out") for part in ("total", *WEIGHTS)))


def _begin(training: Training, output: Path, facts: dict[str, Any], *, resume: bool) -> None:
    """Write settings and the log of a new training, or check them and load the checkpoint of one that goes on."""
    checkpoint, log, rows = output / CHECKPOINT, output / LOG, list[dict[str, str]]()
    if checkpoint.is_file() and not resume:
        raise BadArgument(f"'{output}' already has a training; go on with --resume, or give another folder.")
    if checkpoint.is_file():
        before = read_settings(output)
        changed = [f"{name} was {before.get(name)!r}" for name in facts if before.get(name) != facts[name]]
        if changed:
            raise UnusableTraining(
                f"The training in '{output}' had other settings or demonstrations than these: "
                f"{'; '.join(changed)[:600]}; give the same ones, or another folder."
            )
        training.load(_read_checkpoint(checkpoint))
        with log.open(newline="", encoding="utf-8") as file:  # what came after the checkpoint is made again
            rows = [row for row in csv.DictReader(file) if int(row["step"]) <= training.step]
    with log.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, _COLUMNS)
        writer.writeheader()
        writer.writerows(rows)
    (output / SETTINGS).write_text(json.dumps(facts, indent=1) + "\n", encoding="utf-8")


def read_settings(output: Path) -> dict[str, Any]:
    """Return the settings of a training; `UnusableTraining` if its folder does not have them."""
    try:
        return read_object(output / SETTINGS, UnusableTraining)
    except FileNotFoundError:
        raise UnusableTraining(f"There are no settings of a training in '{output / SETTINGS}'.") from None


def _read_checkpoint(path: Path) -> dict[str, Any]:
    """Read a checkpoint of a training; `UnusableTraining` for one that is damaged or something else."""
    state = load_torch(path, UnusableTraining)
    if not isinstance(state, dict) or not {"average", "step", "seconds"} <= state.keys():
        raise UnusableTraining(f"'{path}' is no checkpoint of a training.")
    return state


def save(training: Training, output: Path) -> None:
    """Write the checkpoint: complete or not at all."""
    partial = output / f"{CHECKPOINT}.partial"
    torch.save(training.state(), partial)
    os.replace(partial, output / CHECKPOINT)


def read_average(output: Path) -> tuple[dict[str, Tensor], int, float]:
    """Return the averaged weights by name, the number of steps, and the seconds of a checkpoint."""
    checkpoint = output / CHECKPOINT
    if not checkpoint.is_file():
        raise UnusableTraining(f"'{output}' has no {CHECKPOINT}; train with `train DEMONSTRATIONS {output}` first.")
    state = _read_checkpoint(checkpoint)
    return state["average"], state["step"], state["seconds"]
