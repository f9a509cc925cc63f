"""Episodes that `va.record` fills: what the caller's loop has of them, and of each policy call."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Never, SupportsIndex

import numpy as np

from vla_attention.capture.effects.measurement import EpisodeEffectsMeasured
from vla_attention.capture.interventions.run_changes import RunChanges
from vla_attention.capture.store.episode_writer import EpisodeWriter
from vla_attention.capture.store.replan_records import ReplanRecord
from vla_attention.capture.torch_policies.attention_calls import CallShape
from vla_attention.capture.torch_policies.recorded_call import RowOfCall
from vla_attention.capture.torch_policies.replan_inputs import (
    EpisodeFacts,
    RepeatedCall,
    read_inputs,
    whole_number,
)
from vla_attention.capture.torch_policies.unseen_attention import no_attention
from vla_attention.schemas.errors import BadArgument, UserError, listing
from vla_attention.schemas.layout import Prompt
from vla_attention.schemas.stores.store_format import episode_name

if TYPE_CHECKING:
    from vla_attention.capture.torch_policies.session import RecordedRun


class RecordingStopped(UserError, RuntimeError):
    """A part of a session was used outside of its block, twice, or inside of another."""


class NothingRecorded(UserError, RuntimeError):
    """An episode in which no attention was seen."""


@dataclass
class Replan:
    """One policy call, inside of its block.

    actions: (horizon, action_dim) or (action_dim,), set by the caller; None: not stored. With several environments, one
        of them each, (environment, ...). All replans of an episode have them, or none.
    recorded: after the block, whether attention ran in it.
    """

    actions: Any = None
    recorded: bool = False


@dataclass
class Episode:
    """An episode that is being recorded. Leaving its block without an exception stores it.

    success: True, False, or None where it is not known. num_steps: number of executed actions; None: not known (0 in
    the store). num_replans, num_dropped: recorded replan blocks, and blocks in which no
    attention ran (the policy answered from a queue). num_whole: recorded ones that were watched throughout.
    """

    run: RecordedRun
    facts: EpisodeFacts
    _changes: RunChanges = field(repr=False)
    success: bool | None = None
    num_steps: int | None = None
    num_dropped: int = 0
    largest_error: float = 0.0
    num_whole: int = 0
    unmet: Mapping[int, tuple[CallShape, str]] = field(default_factory=dict, repr=False)
    folder: Path | None = None
    _batch: EpisodeBatch | None = field(default=None, repr=False)
    _ended: bool = field(default=False, repr=False)
    _stack: ExitStack = field(default_factory=ExitStack, repr=False)
    #: None before the first policy call is recorded.
    _writer: EpisodeWriter | None = field(default=None, repr=False)
    #: What measures the effects of its calls, where the run does.
    _effects: EpisodeEffectsMeasured | None = field(default=None, repr=False)

    @property
    def name(self) -> str:
        """The episode's name in the store."""
        return episode_name(self.facts.task_id, self.facts.episode_index)

    @property
    def num_replans(self) -> int:
        """Number of recorded replans."""
        return 0 if self._writer is None else len(self._writer.records)

    def _append(self, record: ReplanRecord) -> None:
        if self._writer is None:
            self._writer = self._stack.enter_context(self.run._writer_of(self.facts))
        self._writer.append(record)

    @contextmanager
    def replan(
        self,
        *,
        env_step: SupportsIndex,
        frames: Mapping[str, Any] | None = None,
        state: Any = None,
        instruction: str | None = None,
        prompt: Prompt | Sequence[str | None] | None = None,
        roles: Mapping[str, Any] | None = None,
        noise_seed: SupportsIndex | None = None,
        masks: Mapping[str, Any] | None = None,
        coverage: Mapping[str, Any] | None = None,
        dataset_actions: Any = None,
        repeat: Callable[[RepeatedCall], Any] | Callable[[], Any] | None = None,
        # No type fits: for a type checker these are errors, and for `read_inputs` names that do not exist.
        **unknown: Never,
    ) -> Iterator[Replan]:
        """Record the policy call in the block. What is None is not known, or that of the episode.

        Args:
            env_step: the environment step at which the call is made; it increases from call to call.
            frames: camera of the layout -> picture as the policy gets it, (height, width, 3) uint8 or (3, height,
                width) with numbers from 0 to 1; stored in the model's input size.
            state: (state_dim,) numbers.
            instruction: the instruction of this call, where it is not that of the episode.
            prompt: the prompt's pieces, one text for each key of the prompt (None for keys without text), or a
                `Prompt`; None: from the token ids that the policy embeds.
            roles: site -> role codes (key,), where the layout's are not those of this call.
            noise_seed: the seed of this call's noise.
            masks: camera -> (height, width) whole numbers: the number of each pixel's object, counted in the episode's
                `objects`.
            coverage: camera -> (patch, object), the share of each patch that each object covers; instead of masks.
            dataset_actions: (step, action_dim), the actions that a data set has from this call on; no more of them are
                stored than the policy gives actions.
            repeat: makes the policy call again and returns its actions, to measure effects: `lambda call:
                policy.act(..., call.instruction, call.frames)`. Without an argument no word and no picture is
                exchanged. Unused where the run measures no effects.

        Raises:
            BadArgument: an argument or a camera does not exist, or a value has another shape or type.
            CallsDoNotFit: the attention calls are not those of the layout.
            RowsDoNotMatch: the rows do not reproduce what the policy's kernel gave.
            ContributionsUnknown: contributions are recorded, and it is not known what the parts of the keys add.
        """
        if self._batch is not None:
            raise RecordingStopped("This episode is one of several; use the replan of run.episodes(...).")
        inputs = dict(
            frames=frames, state=state, instruction=instruction, prompt=prompt, roles=roles, noise_seed=noise_seed,
            masks=masks, coverage=coverage, dataset_actions=dataset_actions, repeat=repeat, **unknown,
        )  # fmt: skip
        given = read_inputs(self.run.layout, self.facts, env_step, inputs)
        with self.run._replan([RowOfCall(self, given)]) as replan:
            yield replan

    def _commit(self) -> None:
        writer = self._writer
        if writer is None or not writer.records:
            raise NothingRecorded(
                f"No attention was seen in the {self.num_dropped} replan blocks of {self.name}. "
                f"{no_attention(self.run.policy, self.unmet)}"
            )
        facts = {
            **writer.start.provenance,
            "largest P·V error": f"{self.largest_error:.3g}",
            "replan blocks without attention": str(self.num_dropped),
            "watched throughout": f"{self.num_whole} of {self.num_replans} replan blocks, with P·V of every call; the "
            "others in modules that computed attention before, with P·V of one block of each site",
        }
        writer.start = replace(writer.start, provenance=facts)
        self.run._check_weights()
        # Environments give numpy's bools and numbers.
        success = None if self.success is None else bool(self.success)
        num_steps = 0 if self.num_steps is None else whole_number("num_steps of an episode", self.num_steps)
        self.folder = writer.commit(success, num_steps)
        self.run.largest_error = max(self.run.largest_error, self.largest_error)


class EpisodeBatch(list[Episode]):
    """Several episodes whose policy calls are made together.

    Attributes:
        rows: the row of the policy call's batch of each episode.
        batch: number of rows of a policy call.
    """

    def __init__(self, run: RecordedRun, stack: ExitStack, rows: Sequence[int], batch: int) -> None:
        super().__init__()
        self.rows = tuple(rows)
        self.batch = batch
        self._run = run
        self._stack = stack

    @contextmanager
    def replan(
        self,
        *,
        env_step: SupportsIndex | Sequence[SupportsIndex],
        active: Sequence[bool] | None = None,
        frames: Sequence[Mapping[str, Any] | None] | None = None,
        state: Any = None,
        instruction: Sequence[str | None] | None = None,
        prompt: Sequence[Prompt | Sequence[str | None] | None] | None = None,
        roles: Sequence[Mapping[str, Any] | None] | None = None,
        noise_seed: Sequence[SupportsIndex | None] | None = None,
        masks: Sequence[Mapping[str, Any] | None] | None = None,
        coverage: Sequence[Mapping[str, Any] | None] | None = None,
        dataset_actions: Sequence[Any] | None = None,
        **unknown: Never,
    ) -> Iterator[Replan]:
        """Record the policy call of all episodes in the block.

        Args:
            env_step: environment step of all episodes, or of each.
            active: which episodes are recorded; None: all of them. One that has ended is left out.
            frames, state, instruction, prompt, roles, noise_seed, masks, coverage, dataset_actions: as in
                `Episode.replan`, each a sequence with one entry for each episode.
        """
        inputs = dict(
            frames=frames, state=state, instruction=instruction, prompt=prompt, roles=roles, noise_seed=noise_seed,
            masks=masks, coverage=coverage, dataset_actions=dataset_actions, **unknown,
        )  # fmt: skip
        count = len(self)
        check_length("active", active, count)
        chosen = [number for number in range(count) if active is None or active[number]]
        several: Any = env_step
        steps: list[Any] = list(np.asarray(several)) if np.ndim(several) else [several] * count
        for name, values in (("env_step", steps), *(inputs.items())):
            check_length(name, values, count)
        rows = []
        for number in chosen:
            of_row = {name: None if values is None else values[number] for name, values in inputs.items()}
            given = read_inputs(self._run.layout, self[number].facts, steps[number], of_row)
            rows.append(RowOfCall(self[number], given, self.rows[number], number if count > 1 else None))
        if not rows:
            raise BadArgument("No row of the batch is active.")
        with self._run._replan(rows, batch=self.batch, count=count if count > 1 else None) as replan:
            yield replan

    def next_episode(self, row: int, **facts: Any) -> Episode:
        """Store an episode of the batch, by its number, and begin another one in its row; facts as in `run.episode`."""
        self[row]._commit()
        self[row] = self._begin(facts)
        return self[row]

    def _begin(self, facts: Mapping[str, Any]) -> Episode:
        episode = self._run._begin(self._stack, EpisodeFacts(**facts))
        episode._batch = self
        return episode


def rows_of_batch(count: int, rows: Sequence[int] | None, batch: int | None) -> tuple[list[int], int]:
    """Return the row of each of `count` episodes, and the number of rows of a policy call, checked."""
    chosen = [whole_number("row of an episode", row) for row in (range(count) if rows is None else rows)]
    size = count if batch is None else whole_number("batch of run.episodes", batch)
    if len(chosen) != count or len(set(chosen)) != count or not all(0 <= row < size for row in chosen):
        raise BadArgument(
            f"run.episodes has {count} episodes at the rows {listing(chosen)} of a batch of {size}; expected a row of "
            "its own for each of them, counted from 0."
        )
    return chosen, size


def check_length(name: str, values: Any, count: int) -> None:
    """Raise `BadArgument` unless values are None or a sequence with one entry for each episode."""
    if values is None:
        return
    try:
        length = len(values)
    except TypeError:
        raise BadArgument(f"{name} is {values!r}; expected one for each of {count} episodes.") from None
    if length != count or isinstance(values, (str, Mapping)):
        what = f"{length} entries" if length != count else f"the type {type(values).__name__}"
        raise BadArgument(f"{name} has {what}; expected one for each of {count} episodes.")
