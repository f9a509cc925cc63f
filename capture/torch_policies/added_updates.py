"""What a policy adds to its residual stream of the output of one attention call, and what each part of it becomes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import torch
from torch import Tensor, nn


def factors_between(before: Tensor, after: Tensor) -> Tensor:
    """Return what was made of numbers (batch, query, number) float32 by factors; a number that was 0 stays 0."""
    return torch.where(before == 0, 0.0, after / before)


def multiplied(values: Tensor, factors: Tensor | None, row: int) -> Tensor:
    """Return values (query, part, number) of a row of the batch times the call's factors; None: as they are."""
    return values if factors is None else values * factors[row][:, None]


@dataclass(frozen=True)
class AddedUpdate:
    """What was added to the residual stream.

    Factors are numbers of the call, (batch, query, number): a gate, a weight, one over a norm. None: no factor.

    Attributes:
        mixed: the mixed values of the action queries, (batch, query, head · dim) float32.
        before: their factors before the projection.
        projected: what the projection returned for them, (batch, query, width) float32.
        behind: the factors of that before it was added.
        mismatch: how far numbers on the way are from what they should be, relative to the largest; a tensor without
            axes.
        precision: the least precise dtype on the way, such as `bfloat16`.
    """

    mixed: Tensor
    before: Tensor | None
    projected: Tensor
    behind: Tensor | None
    mismatch: Tensor
    precision: str


@dataclass(eq=False)
class OutputWay:
    """The output of one attention call, to be followed to the residual stream.

    Attributes:
        projection: the module that projects it to the width of the stream.
        path: of that module.
        output: what the kernel computed, (batch, head, query, dim); None since it is followed.
        queries: the action queries.
        projects: whether the call projects its output itself, as `nn.MultiheadAttention` does.
        take: called with what was added to the stream; again with None if that was not the stream.
        computed: what was computed of it last that is none of the steps: "module 'x' computes tanh of".
        misfit: what is wrong with what the projection was given or returned, as a sentence without its subject.
    """

    projection: nn.Module
    path: str
    output: Tensor | None
    queries: slice
    projects: bool
    take: Callable[[AddedUpdate | None], None]
    computed: str = field(default="", init=False)
    misfit: str = field(default="", init=False)
    #: Of the output.
    sizes: tuple[int, ...] = field(init=False)
    #: The mixed values of the action queries, (batch, query, head · dim) float32.
    mixed: Tensor = field(init=False)
    #: Their factors before the projection.
    before: Tensor | None = field(default=None, init=False)
    #: What the projection returned for them, (batch, query, width) float32; None before it has run.
    projected: Tensor | None = field(default=None, init=False)
    #: When it began, on the clock of what follows it.
    began: int = field(default=0, init=False)
    mismatches: list[Tensor] = field(default_factory=list, init=False)
    dtypes: set[torch.dtype] = field(default_factory=set, init=False)

    def __post_init__(self) -> None:
        assert self.output is not None
        # A copy: the policy may write over its output.
        self.mixed = self.output[:, :, self.queries].transpose(1, 2).flatten(2).to(torch.float32, copy=True)
        self.sizes = tuple(self.output.shape)
        self.dtypes.add(self.output.dtype)

    @property
    def precision(self) -> str:
        """The least precise dtype so far, such as `bfloat16`."""
        return str(max(self.dtypes, key=lambda dtype: torch.finfo(dtype).eps)).removeprefix("torch.")

    def describe_loss(self) -> str:
        """Say why it was not followed to the residual stream."""
        if self.projected is None:
            if self.computed:
                return f"{self.computed} what the attention gave, before the output projection '{self.path}'"
            return f"the output projection '{self.path}' {self.misfit or 'was not given what the attention gave'}"
        given = f"what the output projection '{self.path}' returned"
        return f"{self.computed} {given}" if self.computed else f"{given} is added to no tensor that was there before"

    def added(self, behind: Tensor | None) -> AddedUpdate:
        """Return what was added, with these factors behind the projection."""
        assert self.projected is not None
        mismatch = torch.stack([*self.mismatches, self.mixed.new_zeros(())]).amax()
        return AddedUpdate(self.mixed, self.before, self.projected, behind, mismatch, self.precision)
