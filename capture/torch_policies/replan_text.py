"""The prompt of the rows of one policy call: token ids that the policy embeds, or what the caller gives."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from vla_attention.capture.torch_policies.policy_layout import PolicyLayout, RecordedSite
from vla_attention.capture.torch_policies.prompt_ids import PromptIds
from vla_attention.capture.torch_policies.prompts import (
    TokenText,
    prompt_from_ids,
    prompt_from_pieces,
    prompt_without_pieces,
    roles_of_keys,
    text_keys,
)
from vla_attention.capture.torch_policies.replan_inputs import ReplanInputs
from vla_attention.capture.torch_policies.site_recorder import SiteRows
from vla_attention.schemas.layout import Prompt


class ReplanText:
    """The text of one policy call, by row of the batch.

    seen: the token ids of the call. inputs: row -> what the caller gave.
    """

    def __init__(
        self, layout: PolicyLayout, tokenizer: TokenText | None, seen: PromptIds, inputs: Mapping[int, ReplanInputs]
    ) -> None:
        self.layout = layout
        self.tokenizer = tokenizer
        self.seen = seen
        self.inputs = inputs
        #: Site -> (key,) bool, the keys that its calls had so far.
        self.present: Mapping[str, NDArray[np.bool_]] = {}

    def prompt(self, row: int, found: Mapping[str, SiteRows] | None) -> Prompt:
        """Return the prompt of a row; `found`: what the call's sites gave, None before the call has ended.

        Raises:
            PromptDoesNotFit: the ids of its words are wanted and were not seen, or do not fit; see `prompt_from_ids`.
        """
        given = self.inputs[row]
        if isinstance(given.prompt, Prompt):
            return given.prompt
        sites = self.layout.text_sites
        if self.layout.text is None or not sites:
            return prompt_without_pieces(given.instruction)
        present = self._present_keys(sites[0], found)
        keys = text_keys(sites[0], self.layout.text.spans, present)
        if given.prompt is not None:
            return prompt_from_pieces(given.prompt, keys, given.instruction)
        if self.tokenizer is None:
            return prompt_without_pieces(given.instruction)
        if self.seen.ids is None:
            raise self.seen.missing()
        valid = None
        if found is not None and any(site.name in found for site in sites):
            # The prompt has the same keys at every site; what else the sites hold differs.
            valid = np.zeros(max(site.keys.num_keys for site in sites), dtype=bool)
            for site in sites:
                if site.name in found:
                    valid[: site.keys.num_keys] |= found[site.name].valid
        return prompt_from_ids(self._text_ids(row), keys, self.tokenizer, given.instruction, valid)

    def roles(
        self,
        row: int,
        site: RecordedSite,
        prompt: Prompt,
        present: NDArray[np.bool_] | None,
        valid: NDArray[np.bool_] | None,
    ) -> NDArray[np.uint8]:
        """Return the role codes of a site's keys, (key,), see `roles_of_keys`."""
        bos = None
        if self.layout.text is not None and self.seen.ids is not None and self.tokenizer is not None:
            ids, first = self._text_ids(row), text_keys(site, self.layout.text.spans, None) if self._has(site) else []
            if ids and first and ids[0] == self.tokenizer.bos:
                bos = first[0]
        return roles_of_keys(site, self.layout, prompt, present, valid, bos, self.inputs[row].roles)

    def early_roles(self, row: int, site: RecordedSite, present: NDArray[np.bool_]) -> NDArray[np.uint8]:
        """Return the roles of a site's keys before the masks are known."""
        return self.roles(row, site, self.prompt(row, None), present, None)

    def _has(self, site: RecordedSite) -> bool:
        return site in self.layout.text_sites

    def _present_keys(self, site: RecordedSite, found: Mapping[str, SiteRows] | None) -> NDArray[np.bool_] | None:
        if found is not None and site.name in found:
            return found[site.name].present
        return self.present.get(site.name)

    def _text_ids(self, row: int) -> list[int]:
        assert self.seen.ids is not None
        assert self.layout.text is not None
        skipped = set(self.layout.text.skip_ids)
        return [token for token in self.seen.ids[row, self.layout.text.skip_first :].tolist() if token not in skipped]
