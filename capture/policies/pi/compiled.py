"""The denoise steps of a pi model as one compiled graph, which gives the rows of every block beside the velocity.

A full-size call on a GPU waits for Python most of its time; a compiled one does not. The graph is the same whether a
call is recorded or not, so that recording changes no action. It costs what it takes to keep the rows of all blocks,
also where few are recorded. The prefix pass stays as it is: how long it is depends on the prompt.

Calls in a batch and calls whose attention is changed run without the graph, with what they are compared with.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from vla_attention.capture.policies.pi.gemma import KeysValues, Rotation
from vla_attention.capture.recording.attention import PieceSink, RowCollector, RowSink, UpdateSink
from vla_attention.capture.recording.contributions import Projection
from vla_attention.schemas.errors import BadArgument

if TYPE_CHECKING:
    from vla_attention.capture.policies.pi.model import Denoising, PiModel


class CannotCompile(BadArgument):
    """A graph that torch.compile does not make on this machine."""


@dataclass
class _Outputs(RowCollector):
    """Keeps what the blocks pass on inside of the graph, which leaves it as outputs; by block."""

    rows: list[Tensor] = field(default_factory=list)
    updates: list[tuple[Tensor, Tensor | None, Tensor]] = field(default_factory=list)

    def sink(self, layer: int, denoise_step: int, action_queries: slice) -> RowSink:
        """See `RowCollector`."""
        return self.rows.append

    def piece_sink(self, layer: int, denoise_step: int, action_queries: slice) -> PieceSink | None:
        """None: the graph has one product with the values, for pieces depend on the prompt."""
        return None

    def update_sink(self, layer: int, denoise_step: int, action_queries: slice) -> UpdateSink:
        """See `RowCollector`."""
        return lambda values, projection, update: self.updates.append((values, projection.gate, update))


class CompiledSteps:
    """Denoise steps of a model for calls of one row; compiled when the first one is made.

    backend: of `torch.compile`.
    """

    def __init__(self, model: PiModel, backend: str = "inductor") -> None:
        self._model = model
        # On a GPU the kernels of a step are replayed as one CUDA graph.
        replayed = backend == "inductor" and model.device.type == "cuda"
        options: dict[str, Any] = {"mode": "reduce-overhead"} if replayed else {}
        self._graph = torch.compile(self._step, backend=backend, dynamic=False, fullgraph=True, **options)

    def _step(
        self, x: Tensor, waves: Tensor, state: Tensor, mask: Tensor, turns: tuple[Tensor, Tensor],
        keys: Sequence[Tensor], values: Sequence[Tensor],
    ) -> tuple[Tensor, list[Tensor], list[tuple[Tensor, Tensor | None, Tensor]]]:  # fmt: skip
        from vla_attention.capture.policies.pi.model import Denoising

        outputs, cache = _Outputs(), tuple(map(KeysValues, keys, values))
        given = Denoising(state, Rotation(*turns), mask, cache, None)
        velocity = self._model.velocity(x, 0, waves, given, outputs)
        return velocity, outputs.rows, outputs.updates

    def velocity(
        self, x: Tensor, step: int, waves: Tensor, denoising: Denoising, recorder: RowCollector | None
    ) -> Tensor:
        """Do what `PiModel.velocity` does, without an editor.

        Raises:
            CannotCompile: torch.compile fails, as without a compiler for C++ or without Triton.
        """
        model, turns = self._model, (denoising.rotation.cos, denoising.rotation.sin)
        keys, values = [entry.keys for entry in denoising.cache], [entry.values for entry in denoising.cache]
        torch.compiler.cudagraph_mark_step_begin()  # type: ignore[no-untyped-call]
        try:
            velocity, rows, updates = self._graph(x, waves, denoising.state, denoising.mask, turns, keys, values)
        except (torch._dynamo.exc.TorchDynamoException, torch._inductor.exc.InductorError) as error:
            why = " ".join(str(error).split("\n")[:2]).strip()
            raise CannotCompile(f"Cannot compile the policy's denoise steps ({why}). Leave --compile out.") from error
        if recorder is not None:
            queries = slice(model.config.first_action_query, model.config.suffix_len)
            for layer, block in enumerate(model._expert.blocks):
                recorder.begin_block(layer, step)
                sink, update_sink = recorder.sink(layer, step, queries), recorder.update_sink(layer, step, queries)
                if sink is not None:
                    sink(rows[layer] if update_sink is None else _kept(rows[layer]))
                if update_sink is not None:
                    read, gate, update = updates[layer]
                    projection = Projection(block.self_attn.o_proj.weight, None if gate is None else _kept(gate))
                    update_sink(_kept(read), projection, _kept(update))
        return velocity.clone()


def _kept(output: Tensor) -> Tensor:
    """What contributions are made of waits for the end of a call, and on a GPU the next step writes over outputs."""
    return output.clone() if output.device.type == "cuda" else output
