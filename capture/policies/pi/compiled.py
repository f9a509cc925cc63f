"""Denoise steps through torch.compile, with the recording inside of the compiled code.

A compiled step has fixed shapes: all keys with their mask, and one product of values. What is recorded of a step is
made in the same graph from the rows that the step uses, and is all that leaves it: the rows of the planned heads (mean
over the queries, pools, or all) and the Gram matrices of the contributions. On a GPU the graph is replayed as a CUDA
graph,
whose outputs live until the next replay, so that they are copied into the recorder's buffer at once.

Compiled arithmetic is the same but for rounding, and rounds differently with and without recording.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import torch
import torch.nn.functional as F
from torch import Tensor

from vla_attention.capture.policies.pi.gemma import KeysValues, Rotation
from vla_attention.capture.recording.attention import AttentionEditor, RowCollector, RowSink, UpdateSink
from vla_attention.capture.recording.contributions import Projection, gram_matrix
from vla_attention.capture.recording.recorder import AttentionRecorder, StepRequest
from vla_attention.schemas.errors import BadArgument

if TYPE_CHECKING:
    from vla_attention.capture.policies.pi.model import Denoising, PiModel

#: (noisy actions, time embedding, state, mask, cosines, sines, keys and values of the prefix by block, request, its
#: tensors) -> velocity, rows (layer, head, query, key) and Gram matrices (layer, part + 1, part + 1), as requested
Step = Callable[..., tuple[Tensor, Tensor | None, Tensor | None]]


class _Tape(RowCollector):
    """Makes what a request asks for of the calls of one step, inside of the compiled code."""

    def __init__(self, request: StepRequest) -> None:
        self.request = request
        self.rows: list[Tensor] = []
        self.grams: list[Tensor] = []
        self.latest: list[Tensor] = []

    def sink(self, layer: int, denoise_step: int, action_queries: slice) -> RowSink | None:
        """Return the function that reduces the rows of a planned layer to what is recorded of them."""
        if layer not in self.request.layers:
            return None

        def take(rows: Tensor) -> None:
            of_actions = rows[0, :, action_queries]
            self.latest.append(of_actions)
            self.rows.append(self.request.reduced(of_actions))

        return take

    def update_sink(self, layer: int, denoise_step: int, action_queries: slice) -> UpdateSink | None:
        """Return the function that makes the Gram matrix of a planned layer."""
        if self.request.members is None or layer not in self.request.layers:
            return None
        members = self.request.members

        def take(values: Tensor, projection: Projection, update: Tensor) -> None:
            mixed = _values_of_members(self.latest[-1], values[0].float(), members)
            projected = F.linear(mixed, projection.weight.float())
            each = projected if projection.gate is None else projected * projection.gate.float()
            self.grams.append(gram_matrix(each, update[0, action_queries]))

        return take


def _values_of_members(rows: Tensor, values: Tensor, members: Tensor) -> Tensor:
    """Return the mixed values (query, part, head · dim) of rows (head, query, key) and values (kv_head, key, dim).

    members: (part, key) float32, 1 for a key of the part. The shapes do not depend on which keys a part has.
    """
    heads, queries, keys = rows.shape
    kv_heads, _, dim = values.shape
    of_parts = (rows[:, :, None] * members).reshape(kv_heads, -1, keys)
    return torch.matmul(of_parts, values).view(heads, queries, -1, dim).permute(1, 2, 0, 3).flatten(2)


@dataclass
class CompiledSteps:
    """The compiled denoise step of a model; one graph for each kind of request."""

    model: PiModel
    step: Step
    #: Policy calls that were made here.
    calls: int = field(default=0, init=False)

    def takes(self, noise: Tensor, recorder: RowCollector | None, editor: AttentionEditor | None) -> bool:
        """Return whether a call goes through the compiled steps; `BadArgument` for interventions on attention.

        Batches, and collectors that look inside of the model, go through the model's own loop.
        """
        if editor is not None:
            raise BadArgument(
                "Cannot use --compile with interventions on attention: the compiled steps do not ask for them; leave "
                "--compile out."
            )
        return noise.shape[0] == 1 and (recorder is None or isinstance(recorder, AttentionRecorder))

    def integrate(
        self, noise: Tensor, all_waves: Tensor, denoising: Denoising, recorder: RowCollector | None
    ) -> Tensor:
        """Return the actions (1, horizon, action dim) float32 of noise of this shape; all_waves: (step, width)."""
        assert recorder is None or isinstance(recorder, AttentionRecorder)
        keys = [entry.keys for entry in denoising.cache]
        values = [entry.values for entry in denoising.cache]
        rotation = denoising.rotation
        x = noise
        for number, waves in enumerate(all_waves):
            request = recorder.step_request(number, noise.device) if recorder is not None else None
            torch.compiler.cudagraph_mark_step_begin()  # type: ignore[no-untyped-call]
            try:
                velocity, rows, grams = self.step(
                    x, waves, denoising.state, denoising.mask, rotation.cos, rotation.sin, keys, values, request
                )
            except Exception as error:
                raise cannot_compile(error) from error
            # The next replay of a CUDA graph writes over what this one gave.
            x = x + (-1.0 / len(all_waves)) * velocity
            if recorder is not None and rows is not None:
                recorder.take_step(number, rows, grams)
        self.calls += 1
        return x


def cannot_compile(error: Exception) -> BadArgument:
    """Return the error of a compiler that does not work here."""
    reason = " ".join(str(error).split()[:40])
    return BadArgument(
        f"Cannot use --compile here: torch.compile failed ({type(error).__name__}: {reason}). It needs a C++ "
        "compiler on the processor and triton on a GPU; leave --compile out."
    )


def compile_steps(model: PiModel, backend: str | Callable[..., Any] = "inductor") -> None:
    """Let a model make its denoise steps through torch.compile, and through CUDA graphs on a GPU.

    backend: of torch.compile. Raises `BadArgument` if it does not compile a small function here.
    """
    options: dict[str, Any] = {"backend": backend, "dynamic": False, "fullgraph": True}
    if backend == "inductor" and model.device.type == "cuda":
        options["mode"] = "reduce-overhead"

    def step(
        x: Tensor,
        waves: Tensor,
        state: Tensor,
        mask: Tensor,
        cos: Tensor,
        sin: Tensor,
        keys: Sequence[Tensor],
        values: Sequence[Tensor],
        request: StepRequest | None,
    ) -> tuple[Tensor, Tensor | None, Tensor | None]:
        from vla_attention.capture.policies.pi.model import Denoising

        tape = None if request is None else _Tape(request)
        cache = tuple(KeysValues(key, value) for key, value in zip(keys, values, strict=True))
        velocity = model.velocity(x, 0, waves, Denoising(state, Rotation(cos, sin), mask, cache, None), tape)
        if tape is None:
            return velocity, None, None
        return velocity, torch.stack(tape.rows), torch.stack(tape.grams) if tape.grams else None

    try:
        trial = torch.compile(lambda x: torch.softmax(x * 2, dim=-1).sum(), **options)
        trial(torch.ones(2, 8, device=model.device))
    except Exception as error:
        raise cannot_compile(error) from error
    model.compiled_steps = CompiledSteps(model, torch.compile(step, **options))
