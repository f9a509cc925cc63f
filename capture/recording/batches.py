"""Recorders of several policy calls that are made as one batch."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from torch import Tensor

from vla_attention.capture.recording.attention import RowCollector, RowSink, UpdateSink
from vla_attention.capture.recording.contributions import Projection


@dataclass(frozen=True)
class BatchCollector(RowCollector):
    """Gives every member of a batch the rows and updates of its own call, as a batch of 1.

    each: one collector per member, in the order of the batch. The projection is the same for all: its gate depends on
    the denoise step only.
    """

    each: Sequence[RowCollector]

    def begin_block(self, layer: int, denoise_step: int) -> None:
        """Tell every member."""
        for collector in self.each:
            collector.begin_block(layer, denoise_step)

    def sink(self, layer: int, denoise_step: int, action_queries: slice) -> RowSink | None:
        """Return the function that shares out the rows of this call, or None if no member wants them."""
        sinks = [collector.sink(layer, denoise_step, action_queries) for collector in self.each]
        if all(sink is None for sink in sinks):
            return None

        def take(rows: Tensor) -> None:
            for member, sink in enumerate(sinks):
                if sink is not None:
                    sink(rows[member : member + 1])

        return take

    def update_sink(self, layer: int, denoise_step: int, action_queries: slice) -> UpdateSink | None:
        """Return the function that shares out the update of this call, or None if no member wants it."""
        sinks = [collector.update_sink(layer, denoise_step, action_queries) for collector in self.each]
        if all(sink is None for sink in sinks):
            return None

        def take(values: Tensor, project: Projection, update: Tensor) -> None:
            for member, sink in enumerate(sinks):
                if sink is not None:
                    own = slice(member, member + 1)
                    sink(values[own], project, update[own])

        return take
