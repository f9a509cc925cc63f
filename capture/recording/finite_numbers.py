"""Policies whose numbers turn NaN or infinite: where in the network that begins.

A replan is checked by its results, which costs nothing. Only when they are not finite, the policy call is repeated with
a look at the output of every module: the same input and noise give the same numbers.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from vla_attention.capture.recording.attention import RowCollector, RowSink
from vla_attention.capture.store.replan_records import RecordedRows
from vla_attention.schemas.errors import UserError


class NumbersNotFinite(UserError, ArithmeticError):
    """The policy computed NaN or infinity. passing: the same call, made again, gave finite numbers."""

    def __init__(self, sentence: str, *, passing: bool = False) -> None:
        super().__init__(sentence)
        self.passing = passing


def not_finite(where: str, origin: str, remedy: str) -> NumbersNotFinite:
    """Return the error of a policy call.

    where: the replan. origin: a sentence about where it began. remedy: what to do; "" for what passes by itself.
    """
    rest = f", and the episodes before it are unharmed; {remedy}" if remedy else ""
    return NumbersNotFinite(
        f"The policy's numbers turned NaN or infinite at {where}. {origin}. Nothing of this episode was kept{rest}.",
        passing=not remedy,
    )


def all_finite(actions: NDArray[np.floating] | None, recorded: Mapping[str, RecordedRows]) -> bool:
    """Whether the results of a policy call are finite: actions, row sums (NaN where a row holds one), contributions."""
    results = [] if actions is None else [actions]
    for site in recorded.values():
        results += [site.row_sum] if site.contribution is None else [site.row_sum, site.contribution]
    return all(bool(np.isfinite(values).all()) for values in results)


@dataclass
class _Watch(RowCollector):
    """Knows which block computes, and keeps the first module whose numbers are not finite."""

    listens_to_modules = True
    position: str = "before the first denoise step"
    origin: str | None = field(default=None)

    def begin_block(self, layer: int, denoise_step: int) -> None:
        """Note that this block begins."""
        self.position = f"at denoise step {denoise_step}, layer {layer}"

    def sink(self, layer: int, denoise_step: int, action_queries: slice) -> RowSink | None:
        """Return None: no rows are wanted."""
        return None

    def look(self, name: str, inputs: Any, output: Any) -> None:
        """Keep the module if it is the first with numbers that are not finite."""
        if self.origin is None and not _finite(output):
            # Sums, softmaxes and products between two modules belong to none: the next one only receives their result.
            part = "output" if _finite(inputs) else "input"
            self.origin = f"{self.position}, in the {part} of {name}"


@contextmanager
def _watched(network: nn.Module) -> Iterator[_Watch]:
    watch = _Watch()
    hooks = [
        module.register_forward_hook(lambda _, inputs, output, name=name: watch.look(name, inputs, output))
        for name, module in network.named_modules()
        if name
    ]
    try:
        yield watch
    finally:
        for hook in hooks:
            hook.remove()


def describe_origin(
    network: nn.Module,
    call: Callable[[Mapping[str, RowCollector]], NDArray[np.floating]],
    sites: tuple[str, ...],
) -> tuple[str, bool]:
    """Repeat a policy call, and say where its numbers stop being finite.

    Args:
        network: of the policy.
        call: runs the policy on the same input and noise, with the given row collector of each site; returns actions.
        sites: names of the sites.

    Returns:
        A sentence, and whether all numbers of the repeated call are finite.
    """
    with _watched(network) as watch:
        actions = call(dict.fromkeys(sites, watch))
    if watch.origin is not None:
        return f"They begin {watch.origin}", False
    if np.isfinite(actions).all():
        return "The same call, made again, gave finite numbers: the processor or its memory erred", True
    return (
        "All modules of the network give finite numbers: look at the normalisation statistics of the checkpoint",
        False,
    )


def _finite(values: Any) -> bool:
    """Whether all floating-point tensors in (nested) arguments or results of a module are finite."""
    if isinstance(values, Tensor):
        return not values.is_floating_point() or bool(torch.isfinite(values).all())
    if isinstance(values, Mapping):
        return all(map(_finite, values.values()))
    return all(map(_finite, values)) if isinstance(values, (tuple, list)) else True
