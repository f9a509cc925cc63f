"""The prompt of the rows of one policy call: token ids that the policy embeds, or what the caller gives."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from typing import Any

import numpy as np
from numpy.typing import NDArray
from torch import Tensor, nn

from vla_attention.capture.torch_policies.policy_layout import PolicyLayout, RecordedSite
from vla_attention.capture.torch_policies.policy_modules import find_module, modules_of
from vla_attention.capture.torch_policies.prompts import (
    PromptDoesNotFit,
    TokenText,
    prompt_from_ids,
    prompt_from_pieces,
    prompt_without_pieces,
    roles_of_keys,
    text_keys,
)
from vla_attention.capture.torch_policies.replan_inputs import ReplanInputs
from vla_attention.capture.torch_policies.site_recorder import SiteRows
from vla_attention.schemas.errors import BadArgument, listing
from vla_attention.schemas.layout import Prompt


class KeysShifted(BadArgument):
    """Keys of a row of the batch that are not at the places that the layout gives them."""


_Look = Callable[[nn.Module, tuple[Any, ...], dict[str, Any]], None]


def embeddings_of(policy: object, layout: PolicyLayout) -> dict[str, nn.Module]:
    """Return the embeddings of a policy by path, that of the layout's prompt first; none where it has no prompt.

    Raises:
        UnknownName: the policy has no module at the path that the layout gives.
    """
    if layout.text is None:
        return {}
    path = layout.text.embedding
    first = {path: find_module(policy, path, "token ids")}
    return first | {name: module for name, module in modules_of(policy).items() if isinstance(module, nn.Embedding)}


class PromptIds:
    """What the embeddings of a policy are given in one policy call.

    embeddings: by path, the prompt's first, see `embeddings_of`. batch: number of rows of the call.

    Attributes:
        ids: (row of the batch, token) int64, the longest that the prompt's embedding was given; None: none so far.
    """

    def __init__(self, embeddings: Mapping[str, nn.Module], batch: int) -> None:
        self.ids: NDArray[np.int64] | None = None
        self._embeddings = embeddings
        self._batch = batch
        #: Path -> the shape of the largest whole numbers that the module was given.
        self._called: dict[str, tuple[int, ...]] = {}

    @contextmanager
    def watched(self) -> Iterator[None]:
        """Look at what the embeddings are given within the block."""
        with ExitStack() as stack:
            for number, (path, module) in enumerate(self._embeddings.items()):
                look = self._look(path, is_prompt=number == 0)
                stack.callback(module.register_forward_pre_hook(look, with_kwargs=True).remove)
            yield

    def _look(self, path: str, *, is_prompt: bool) -> _Look:
        def look(_module: nn.Module, arguments: tuple[Any, ...], named: dict[str, Any]) -> None:
            given = next((value for value in (*arguments, *named.values()) if isinstance(value, Tensor)), None)
            if given is None or given.is_floating_point():
                return
            self._called[path] = max(self._called.get(path, tuple(given.shape)), tuple(given.shape), key=np.prod)
            rows = given[None] if given.ndim == 1 else given
            if not is_prompt or rows.ndim != 2 or len(rows) != self._batch:
                return
            if self.ids is None or rows.shape[1] > self.ids.shape[1]:
                self.ids = rows.detach().cpu().numpy().astype(np.int64)

        return look

    def missing(self) -> PromptDoesNotFit:
        """Return the error for a call in which the prompt's embedding was given no ids: it says which others were."""
        path, module = next(iter(self._embeddings.items()))
        if path in self._called:
            return PromptDoesNotFit(
                f"The module '{path}', which embeds the prompt as the layout says, was given whole numbers of the "
                f"shape {self._called[path]}, and the policy call has a batch of {self._batch}: expected token ids "
                f"(batch, token). {_OTHERWISE}"
            )
        tied = {name for name in self._called if _same_weights(self._embeddings[name], module)}
        others = sorted(self._called, key=lambda name: (name not in tied, -np.prod(self._called[name])))
        seen = [f"'{name}' {self._called[name]}{' with the same weights' * (name in tied)}" for name in others]
        what = f"Embeddings that were given whole numbers: {listing(seen)}" if seen else "No embedding was called"
        return PromptDoesNotFit(
            f"The module '{path}', which embeds the prompt as the layout says, was not called before its token ids "
            f"were needed. {what}. Name the one that embeds the prompt in PromptText.embedding. {_OTHERWISE}"
        )


_OTHERWISE = (
    "Where a policy keeps an embedded prompt, or embeds it otherwise, give its pieces with replan(prompt=...), or "
    "record without a tokenizer."
)


def _same_weights(one: nn.Module, other: nn.Module) -> bool:
    """Whether two embeddings share their numbers, as tied ones do."""
    first, second = getattr(one, "weight", None), getattr(other, "weight", None)
    return isinstance(first, Tensor) and isinstance(second, Tensor) and first.data_ptr() == second.data_ptr()


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

    def prompt(self, row: int, rows_of_sites: Mapping[str, SiteRows] | None) -> Prompt:
        """Return the prompt of a row; `rows_of_sites`: what the call's sites gave, None before the call has ended.

        Raises:
            PromptDoesNotFit: the ids of its words are wanted and were not seen, or do not fit; see `prompt_from_ids`.
        """
        given = self.inputs[row]
        if isinstance(given.prompt, Prompt):
            return given.prompt
        sites = self.layout.text_sites
        if self.layout.text is None or not sites:
            return prompt_without_pieces(given.instruction)
        if given.prompt is not None:
            keys = self._keys(rows_of_sites, len(given.prompt))
            return prompt_from_pieces(given.prompt, keys, given.instruction)
        if self.tokenizer is None:
            return prompt_without_pieces(given.instruction)
        if self.seen.ids is None:
            raise self.seen.missing()
        valid = None
        if rows_of_sites is not None and any(site.name in rows_of_sites for site in sites):
            # The prompt has the same keys at every site; what else the sites hold differs.
            valid = np.zeros(max(site.keys.num_keys for site in sites), dtype=bool)
            for site in sites:
                if site.name in rows_of_sites:
                    valid[: site.keys.num_keys] |= rows_of_sites[site.name].valid
        ids = self._text_ids(row)
        keys = self._keys(rows_of_sites, len(ids))
        return prompt_from_ids(ids, keys, self.tokenizer, given.instruction, valid)

    def _keys(self, rows_of_sites: Mapping[str, SiteRows] | None, count: int) -> list[int]:
        """Return the keys of the prompt's tokens, the same at every site that has them; count: number of tokens."""
        assert self.layout.text is not None
        spans, sites = self.layout.text.spans, self.layout.text_sites
        present = {**self.present, **{name: of.present for name, of in (rows_of_sites or {}).items()}}
        for site in sites:
            if site.name in present:
                return text_keys(site, spans, present[site.name])
        # None of these calls has run yet. Then the number of tokens says how long a prompt of changing length is.
        keys = text_keys(sites[0], spans, None)
        if sites[0].variable_span in spans and count < len(keys):
            variable = sites[0].keys.span(sites[0].variable_span)
            keys = [key for key in keys if not variable.stop - (len(keys) - count) <= key < variable.stop]
        return keys

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
            ids = self._text_ids(row)
            first = text_keys(site, self.layout.text.spans, None) if site in self.layout.text_sites else []
            if ids and first and ids[0] == self.tokenizer.bos:
                bos = first[0]
        return roles_of_keys(site, self.layout, prompt, present, valid, bos, self.inputs[row].roles)

    def early_roles(self, row: int, site: RecordedSite, present: NDArray[np.bool_]) -> NDArray[np.uint8]:
        """Return the roles of a site's keys before the masks are known."""
        self.check_places(row, site, present, None)
        # Where none of them is the prompt's, its token ids need not have been seen yet.
        of_text = site in self.layout.text_sites
        prompt = self.prompt(row, None) if of_text else prompt_without_pieces(self.inputs[row].instruction)
        return self.roles(row, site, prompt, present, None)

    def check_places(
        self, row: int, site: RecordedSite, present: NDArray[np.bool_] | None, valid: NDArray[np.bool_] | None
    ) -> None:
        """Raise `KeysShifted` where a row's keys are not at the places of the layout, as padding on the left does.

        Token ids with placeholders for patches tell it for each key. Without them, patches do whose first keys nothing
        may see while no key behind them is padding, of the patches or of the text: a camera without a picture is masked
        whole, and the edges of a picture that is not square on both sides.
        """
        given, text = self.inputs[row].roles, self.layout.text if site in self.layout.text_sites else None
        spans = text.spans if text is not None else [span.name for span in site.keys.spans if span.kind == "text"]
        if not spans or (given and site.name in given):
            return
        keys = np.arange(site.keys.num_keys) if present is None else np.flatnonzero(present)
        of_text = np.isin(keys, text_keys(site, spans, None))
        wrong, known = None, False
        if self.seen.ids is not None and text is not None and text.skip_ids:
            ids = self.seen.ids[row]
            is_text = ~np.isin(ids, text.skip_ids)
            is_text[: text.skip_first] = False
            known = bool(of_text.any()) and len(ids) == np.flatnonzero(of_text)[-1] + 1
            if known and (is_text != of_text[: len(ids)]).any():
                first = int(np.argmax(is_text != of_text[: len(ids)]))
                # Nothing but skipped ids from there on: the padding on the right is among them.
                wrong = keys[first] if is_text[first:].any() else None
        if not known and valid is not None:
            first = keys[np.argmax(valid[keys])]
            span = site.keys.spans[site.keys.span_of_key()[first]]
            behind = keys[(keys > first) & (of_text | (keys < span.stop))]
            shifted = span.kind == "image" and first > max(span.start, keys[0]) and valid[behind].all()
            wrong = span.start if shifted else None
        if wrong is not None:
            span = site.keys.spans[site.keys.span_of_key()[wrong]]
            raise KeysShifted(
                f"In row {row} of the batch, key {wrong - span.start} of the span '{span.name}' of site '{site.name}' "
                "is not what the layout says: the row begins with padding. Pad prompts on the right "
                "(tokenizer.padding_side = 'right'), call the policy for one environment at a time, or give the keys' "
                "roles with replan(roles=...)."
            )

    def _text_ids(self, row: int) -> list[int]:
        assert self.seen.ids is not None
        assert self.layout.text is not None
        skipped = set(self.layout.text.skip_ids)
        return [token for token in self.seen.ids[row, self.layout.text.skip_first :].tolist() if token not in skipped]
