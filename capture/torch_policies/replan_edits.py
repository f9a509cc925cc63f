"""What knockouts add to the logits of the calls of one replan."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from vla_attention.capture.interventions.resolution import ReplanPlace
from vla_attention.capture.torch_policies.attention_calls import CallShape
from vla_attention.capture.torch_policies.call_order import CallPlace
from vla_attention.capture.torch_policies.knockouts import edits_at, logit_bias
from vla_attention.capture.torch_policies.replan_inputs import ReplanInputs
from vla_attention.capture.torch_policies.replan_text import ReplanText
from vla_attention.capture.torch_policies.site_recorder import ReplanRecorder

if TYPE_CHECKING:
    from vla_attention.capture.torch_policies.session import Episode, RecordedRun


@dataclass
class ReplanEdits:
    """What knockouts add to the logits of the calls of one replan; the keys are looked up at its first call."""

    run: RecordedRun
    episodes: Mapping[int, tuple[Episode, ReplanInputs]]
    text: ReplanText
    recorder: ReplanRecorder | None = None
    _of_row: dict[int, dict[str, Any]] = field(default_factory=dict)
    _known: dict[tuple[Any, ...], NDArray[np.float32]] = field(default_factory=dict)

    def bias(self, row: int, place: CallPlace, shape: CallShape) -> NDArray[np.float32] | None:
        """Return what is added to the logits of a call in one row of the batch, (head or 1, query, key).

        Calls to which the same is added get the same array.
        """
        if row not in self._of_row:
            self._of_row[row] = self._edits(row)
        edits = edits_at(self._of_row[row].get(place.site or "", ()), place)
        if not edits:
            return None
        # Where the keys of calls differ, they differ from token to token.
        token = -1 if place.keys is None else place.step
        sizes = shape.heads, shape.queries, shape.keys, place.queries.start, place.queries.stop, token
        call = row, place.site, tuple(id(edit) for edit in edits), *sizes
        if call not in self._known:
            self._known[call] = logit_bias(edits, place, shape)
        return self._known[call]

    def _edits(self, row: int) -> dict[str, Any]:
        episode, inputs = self.episodes[row]
        prompt = self.text.prompt(row, None)
        sites = self.run._sites
        assert self.recorder is not None
        present = self.recorder.order.present
        roles = {site.name: self.text.roles(row, site, prompt, present.get(site.name), None) for site in sites}
        place = ReplanPlace(episode.facts.task_id, episode.facts.episode_index, episode.num_replans)
        return dict(
            self.run.knockouts.edits(
                self.run.attributes.sites, roles, prompt, episode.facts.objects, inputs.coverage, place
            )
        )
