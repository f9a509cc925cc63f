"""The prompt of the rows of one policy call, and the roles of its keys.

It comes from the token ids that the policy's own embedding was given, since a second tokenization could differ, or from
what the caller gives.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from functools import partial
from itertools import accumulate, pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray
from torch import Tensor, nn

from vla_attention.capture.torch_policies.policy_layout import PolicyLayout, RecordedSite
from vla_attention.capture.torch_policies.prompts import PromptDoesNotFit, TokenText, find_instruction, state_pieces
from vla_attention.capture.torch_policies.replan_inputs import ReplanInputs
from vla_attention.schemas.errors import BadArgument, listing, unknown_name
from vla_attention.schemas.fitted_pictures import with_borders
from vla_attention.schemas.layout import ROLE_DTYPE, Piece, Prompt, Role, roles_from_spans


class KeysShifted(BadArgument):
    """Keys of a row of the batch that are not at the places that the layout gives them."""


def embeddings_of(modules: Mapping[str, nn.Module], layout: PolicyLayout) -> dict[str, nn.Module]:
    """Return the embeddings of a policy by path, that of the layout's prompt first; none where it has no prompt.

    Raises:
        UnknownName: the policy has no module at the path that the layout gives.
    """
    if layout.text is None:
        return {}
    path = layout.text.embedding
    if path not in modules:
        raise unknown_name("module for token ids", path, [name for name in modules if name])
    return {path: modules[path]} | {name: part for name, part in modules.items() if isinstance(part, nn.Embedding)}


class PromptIds:
    """What the embeddings of a policy are given in one policy call.

    embeddings: by path, the prompt's first, see `embeddings_of`. batch: number of rows of the call.

    Attributes:
        ids: (row of the batch, token) int64, the longest that the prompt's embedding was given; None: none so far.
    """

    def __init__(self, embeddings: Mapping[str, nn.Module], batch: int) -> None:
        self.ids: NDArray[np.int64] | None = None
        #: The same of what it was given afterwards: the tokens that the policy wrote.
        self.written: list[Tensor] = []
        self._embeddings = embeddings
        self._batch = batch
        #: Path -> the shape of the largest whole numbers that the module was given.
        self._called: dict[str, tuple[int, ...]] = {}

    @contextmanager
    def watched(self) -> Iterator[None]:
        """Look at what the embeddings are given within the block."""
        with ExitStack() as stack:
            for path, module in self._embeddings.items():
                handle = module.register_forward_pre_hook(partial(self._look, path), with_kwargs=True)
                stack.callback(handle.remove)
            yield

    def _look(self, path: str, _module: nn.Module, arguments: tuple[Any, ...], named: dict[str, Any]) -> None:
        given = next((value for value in (*arguments, *named.values()) if isinstance(value, Tensor)), None)
        if given is None or given.is_floating_point() or given.is_meta:
            return
        self._called[path] = max(self._called.get(path, tuple(given.shape)), tuple(given.shape), key=np.prod)
        rows = given[None] if given.ndim == 1 else given
        is_prompt = path == next(iter(self._embeddings)) and rows.ndim == 2 and len(rows) == self._batch
        if not is_prompt:
            return
        if self.ids is None or rows.shape[1] > self.ids.shape[1]:
            self.ids, self.written = rows.detach().cpu().numpy().astype(np.int64), []
        else:
            self.written.append(rows.detach().clone())

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


@dataclass
class ReplanText:
    """The text of one policy call, by row of the batch.

    seen: the token ids of the call. inputs: row -> what the caller gave. present: site -> (key,) bool, the keys that
    the site's calls had so far.
    """

    layout: PolicyLayout
    tokenizer: TokenText | None
    seen: PromptIds
    inputs: Mapping[int, ReplanInputs]
    present: Mapping[str, NDArray[np.bool_]]

    def prompt(self, row: int, valid: Mapping[str, NDArray[np.bool_]]) -> Prompt:
        """Return the prompt of a row; special tokens and keys that the policy cannot see have no piece.

        valid: site -> (key,) bool, the keys that the call's action queries can see; of no site before it has ended.

        Raises:
            PromptDoesNotFit: the ids of its words are wanted and were not seen, or the numbers of ids and keys differ,
                or the instruction is not in the text.
        """
        given, sites = self.inputs[row], self.layout.text_sites
        if isinstance(given.prompt, Prompt):
            return given.prompt
        kept: list[tuple[Any, int]]
        if given.prompt is not None and not sites:
            raise PromptDoesNotFit(
                f"replan(prompt=...) was given {len(given.prompt)} pieces, and the layout '{self.layout.name}' does "
                "not say which keys they are: give it text=va.PromptText(spans, embedding), or leave the prompt out."
            )
        if sites and given.prompt is not None:
            keys = self._keys_of_tokens(len(given.prompt), 0)
            if len(keys) != len(given.prompt):
                raise PromptDoesNotFit(
                    f"The prompt was given as {len(given.prompt)} pieces, and the layout's prompt has {len(keys)} "
                    "keys: give one piece for each key, None where it has no text."
                )
            kept = [(piece, key) for piece, key in zip(given.prompt, keys, strict=True) if piece]
            text = "".join(piece for piece, _ in kept)
            ranges = tuple(pairwise(accumulate((len(piece) for piece, _ in kept), initial=0)))
        elif sites and self.tokenizer is not None:
            if self.seen.ids is None:
                raise self.seen.missing()
            ids, written = self._text_ids(row), self._written_ids(row)
            keys = self._keys_of_tokens(len(ids), len(written))
            ids += written
            if len(ids) != len(keys):
                raise PromptDoesNotFit(
                    f"The policy embedded {len(ids) - len(written)} text tokens, and {len(written)} more behind them; "
                    f"the layout's prompt has {len(keys)} keys: change its spans, or its skip_ids (placeholders for "
                    "patches). Where the policy writes tokens itself before it acts, as a subtask, give them a span "
                    "named in PromptText.generated; else give the text with replan(prompt=...)."
                )
            # The prompt has the same keys at every site.
            seen = [valid[site.name] for site in sites if site.name in valid]
            kept = [
                (token, key)
                for token, key in zip(ids, keys, strict=True)
                if token not in self.tokenizer.special and (not seen or any(of_site[key] for of_site in seen))
            ]
            text, ranges = self.tokenizer.pieces(tuple(token for token, _ in kept))
        else:
            return Prompt(given.instruction, (), (0, len(given.instruction)))
        pieces = tuple(Piece(key, text[a:b], a, b) for (_, key), (a, b) in zip(kept, ranges, strict=True))
        return Prompt(text, pieces, find_instruction(text, given.instruction))

    def _keys_of_tokens(self, count: int, num_written: int) -> list[int]:
        """Return the keys of the prompt's tokens, and behind them those of the tokens that the policy wrote.

        count, num_written: their numbers. A policy may embed both again, in one call.
        """
        assert self.layout.text is not None
        keys = self._keys(count)
        if not self.layout.text.generated:
            return keys
        site = self.layout.text_sites[0]
        present = self.present.get(site.name)
        generated = [key for key in _keys_of(site, self.layout.text.generated) if present is None or present[key]]
        return keys + generated if num_written or count > len(keys) else keys

    def _keys(self, count: int) -> list[int]:
        """Return the keys of the prompt's tokens, the same at every site that has them; count: number of tokens."""
        sites = self.layout.text_sites
        for site in sites:
            if site.name in self.present:
                return [key for key in self._text_keys(site) if self.present[site.name][key]]
        # None of these calls has run yet. Then the number of tokens says how long a prompt of changing length is.
        keys = self._text_keys(sites[0])
        if sites[0].variable_span in self.spans and count < len(keys):
            variable = sites[0].keys.span(sites[0].variable_span)
            keys = [key for key in keys if not variable.stop - (len(keys) - count) <= key < variable.stop]
        return keys

    def roles(
        self, row: int, site: RecordedSite, prompt: Prompt, valid: NDArray[np.bool_] | None = None
    ) -> NDArray[np.uint8]:
        """Return the role codes of a site's keys, (key,).

        Keys of the prompt are `instruction` inside the instruction's characters and `template` elsewhere, where pieces
        are known. Keys that exist in no call are `absent`; keys that no action query may see are `masked_image` or
        `padding`; `valid`: (key,) bool, those that some may see, None for all.
        """
        given, present = self.inputs[row].roles, self.present.get(site.name)
        if site.name in given:
            roles = np.array(given[site.name], dtype=ROLE_DTYPE)
            if roles.shape != (site.keys.num_keys,):
                raise BadArgument(
                    f"The roles given for site '{site.name}' have the shape {roles.shape}; expected one code for each "
                    f"of {site.keys.num_keys} keys."
                )
        else:
            roles = roles_from_spans(site.keys, {span.name: site.role_of(span) for span in site.keys.spans})
            if prompt.pieces and site in self.layout.text_sites:
                self._name_text(roles, row, site, prompt)
        for span in site.keys.spans:
            keys_of_span = slice(span.start, span.stop)
            if valid is not None:
                roles[keys_of_span][~valid[keys_of_span]] = site.masked_role(span)
            if present is not None:
                roles[keys_of_span][~present[keys_of_span]] = Role.ABSENT
        return with_borders(site.keys, roles, self.inputs[row].shown)

    def _name_text(self, roles: NDArray[np.uint8], row: int, site: RecordedSite, prompt: Prompt) -> None:
        """Give the keys of the prompt the roles of their pieces."""
        assert self.layout.text is not None
        keys = self._text_keys(site)
        roles[[key for key in keys if roles[key] == Role.INSTRUCTION]] = Role.TEMPLATE
        first, last = prompt.instruction
        for piece in prompt.pieces:
            if piece.key not in keys:  # written by the policy
                continue
            roles[piece.key] = Role.INSTRUCTION if piece.start < last and piece.stop > first else Role.TEMPLATE
        for piece in state_pieces(prompt, self.layout.text.state_between) if self.layout.text.state_between else ():
            roles[piece.key] = Role.STATE
        if self.tokenizer is not None and self._text_ids(row)[:1] == [self.tokenizer.bos]:
            roles[keys[0]] = Role.BOS

    def early_roles(self, row: int, site: RecordedSite) -> NDArray[np.uint8]:
        """Return the roles of a site's keys before the masks are known."""
        self.check_places(row, site, None)
        # Where none of them is the prompt's, its token ids need not have been seen yet.
        prompt = self.prompt(row, {}) if site in self.layout.text_sites else Prompt("", (), (0, 0))
        return self.roles(row, site, prompt)

    def check_places(self, row: int, site: RecordedSite, valid: NDArray[np.bool_] | None) -> None:
        """Raise `KeysShifted` where a row's keys are not at the places of the layout, as padding on the left does.

        Token ids with placeholders for patches tell it for each key. Without them, patches do whose first keys nothing
        may see while no key behind them is padding, of the patches or of the text: a camera without a picture is masked
        whole, and the edges of a picture that is not square on both sides.
        """
        text = self.layout.text if site in self.layout.text_sites else None
        spans = text.spans if text is not None else [span.name for span in site.keys.spans if span.kind == "text"]
        if not spans or site.name in self.inputs[row].roles:
            return
        keys = np.flatnonzero(self.present[site.name])
        of_text = np.isin(keys, _keys_of(site, spans))
        wrong, known = None, False
        if self.seen.ids is not None and text is not None and text.skip_ids:
            ids = self._seen_ids(row)
            is_text = ~np.isin(ids, text.skip_ids)
            is_text[: text.skip_first] = False
            known = bool(of_text.any()) and len(ids) in (np.flatnonzero(of_text)[-1] + 1, len(keys))
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
        if self.seen.ids is None or self.layout.text is None:
            return []
        skipped = set(self.layout.text.skip_ids)
        return [token for token in self._seen_ids(row)[self.layout.text.skip_first :].tolist() if token not in skipped]

    def _seen_ids(self, row: int) -> NDArray[np.int64]:
        """The ids of a row, (token,), but for those behind the last that has a key."""
        assert self.seen.ids is not None
        assert self.layout.text is not None
        return self.seen.ids[row, : self.seen.ids.shape[1] - self.layout.text.skip_last]

    def _written_ids(self, row: int) -> list[int]:
        """The ids of the tokens that the policy wrote itself; none where the layout has no spans for them."""
        if self.layout.text is None or not self.layout.text.generated:
            return []
        return [token for ids in self.seen.written for token in ids[row].tolist()]

    @property
    def spans(self) -> tuple[str, ...]:
        """The spans of the prompt's tokens."""
        return () if self.layout.text is None else self.layout.text.spans

    def _text_keys(self, site: RecordedSite) -> list[int]:
        return _keys_of(site, self.spans)


def _keys_of(site: RecordedSite, spans: Sequence[str]) -> list[int]:
    """The keys of spans, in their order."""
    return [key for name in spans for key in range(site.keys.span(name).start, site.keys.span(name).stop)]
