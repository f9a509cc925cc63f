"""Observer of one network evaluation (rows of the recorded frame's queries, and their updates), and its editor."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from torch import Tensor

from vla_attention.capture.policies.cosmos.dit import Attention
from vla_attention.capture.policies.cosmos.layout import SELF
from vla_attention.capture.recording.attention import AttentionEditor, LogitChange, RowCollector, RowSink, UpdateSink
from vla_attention.capture.recording.contributions import Projection


@dataclass
class CallObserver:
    """Passes rows and updates of the queries of `query_frame` on to the recorders of the sites.

    Rows and contributions come from the probabilities that the model itself uses; nothing is computed twice.
    """

    denoise_step: int
    query_frame: int
    tokens_per_frame: int
    recorders: Mapping[str, RowCollector]
    #: site -> values and output weight of the current block, until its gates are known
    _seen: dict[str, tuple[Tensor, Tensor]] = field(default_factory=dict, init=False, repr=False)

    @property
    def _queries(self) -> slice:
        return slice(0, self.tokens_per_frame)

    def _update_sinks(self, layer: int) -> dict[str, UpdateSink]:
        found = {
            site: recorder.update_sink(layer, self.denoise_step, self._queries)
            for site, recorder in self.recorders.items()
        }
        return {site: sink for site, sink in found.items() if sink is not None}

    def begin_block(self, layer: int) -> None:
        """Tell the recorders that this block begins."""
        for recorder in self.recorders.values():
            recorder.begin_block(layer, self.denoise_step)

    def rows(self, site: str, layer: int, frame: int, attention: Attention, value: Tensor) -> RowSink | None:
        """Return the function that takes the rows of these queries, or None if they are not recorded."""
        recorder = self.recorders.get(site)
        if frame != self.query_frame or recorder is None:
            return None
        if recorder.update_sink(layer, self.denoise_step, self._queries) is not None:
            self._seen[site] = value, attention.output_proj.weight
        return recorder.sink(layer, self.denoise_step, self._queries)

    def takes_updates(self, layer: int) -> bool:
        """Return whether contributions of this block are recorded at any site."""
        return bool(self._update_sinks(layer))

    def updates(self, layer: int, updates: dict[str, Tensor], gates: dict[str, Tensor], block_input: Tensor) -> None:
        """Pass values, projection and update of the recorded queries on to the recorders."""
        for site, sink in self._update_sinks(layer).items():
            value, weight = self._seen.pop(site)
            sink(value, Projection(weight, gates[site][0, self.query_frame]), updates[site][:, self.query_frame])


@dataclass(frozen=True)
class CallEditor:
    """Asks the editors of the sites for the changes of one network evaluation.

    The queries of `query_frame` are the action queries. At `self`, every token is a key too.
    """

    denoise_step: int
    query_frame: int
    tokens_per_frame: int
    editors: Mapping[str, AttentionEditor]

    def change(self, site: str, layer: int, frame: int) -> LogitChange | None:
        """Return the change of the logits (batch, head, query of the frame, key), or None."""
        editor = self.editors.get(site)
        if editor is None:
            return None
        count = self.tokens_per_frame
        action_queries = slice(0, count if frame == self.query_frame else 0)
        own_keys = slice(frame * count, (frame + 1) * count) if site == SELF else None
        return editor.step_change(layer, self.denoise_step, action_queries, own_keys)
