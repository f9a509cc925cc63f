"""The token ids of one policy call: what the policy's text embedding is given, and what its other embeddings are."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from typing import Any

import numpy as np
from numpy.typing import NDArray
from torch import Tensor, nn

from vla_attention.capture.torch_policies.policy_layout import PolicyLayout
from vla_attention.capture.torch_policies.policy_modules import modules_of
from vla_attention.capture.torch_policies.policy_weights import find_module
from vla_attention.capture.torch_policies.prompts import PromptDoesNotFit
from vla_attention.schemas.errors import listing

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
            if is_prompt and given.ndim in (1, 2):
                self._keep(given if given.ndim == 2 else given[None])

        return look

    def _keep(self, rows: Tensor) -> None:
        if len(rows) == self._batch and (self.ids is None or rows.shape[1] > self.ids.shape[1]):
            self.ids = rows.detach().cpu().numpy().astype(np.int64)

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
