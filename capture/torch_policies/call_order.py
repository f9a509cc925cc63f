"""Which site, block and denoise step each attention call of a replan is, and what does not fit the layout.

What does not fit is kept and raised at the end of the replan, so that the error can show all calls.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from vla_attention.capture.torch_policies.attention_calls import CallShape
from vla_attention.capture.torch_policies.inspect_calls import CallTable
from vla_attention.capture.torch_policies.policy_layout import CallRule, PolicyLayout, RecordedSite
from vla_attention.schemas.errors import BadArgument, UserError, listing


class CallsDoNotFit(UserError, ValueError):
    """The attention calls of a policy are not those of its layout. The message ends with a table of the calls."""


@dataclass(frozen=True)
class CallPlace:
    """What one call is.

    step: the denoise step; of an autoregressive policy the number of the generated token. site, block: None for calls
    that are not recorded. queries: positions of the action queries. keys: (key of the call,) the site's key of each key
    of the call, None where they are the same.
    """

    rule: CallRule
    site: str | None = None
    block: int = -1
    step: int = -1
    queries: slice = field(default_factory=lambda: slice(0))
    keys: NDArray[np.int64] | None = None


class CallOrder:
    """Gives the calls of one replan their places, one after the other. Every replan needs a new one."""

    def __init__(self, layout: PolicyLayout, policy: str) -> None:
        self.layout = layout
        self.policy = policy
        self.sites = {site.name: site for site in layout.sites}
        self.seen: list[CallShape] = []
        self.problems: dict[str, None] = {}
        self.fired: Counter[tuple[str, int]] = Counter()
        #: Site -> (key,) bool: the keys that some call had.
        self.present: dict[str, NDArray[np.bool_]] = {}
        self._calls_of_rule: Counter[int] = Counter()
        self._variable: dict[str, int] = {}

    def place(self, shape: CallShape, *, ran: bool) -> CallPlace | None:
        """Return what the next call is, or None if it does not fit.

        ran: the call has run, and the one after it is the next. Before it has run, nothing is counted: a softmax may
        turn out not to be attention.
        """
        if ran:
            self.seen.append(shape)
        for number, rule in enumerate(self.layout.rules):
            match = rule.fits(shape.module, shape.kind, shape.queries, shape.keys)
            if match is None:
                continue
            if not rule.sites:
                return CallPlace(rule)
            if rule.sequence:
                site, block = rule.sequence[self._calls_of_rule[number] % len(rule.sequence)]
                self._calls_of_rule[number] += ran
            else:
                site, block = rule.sites[0], int(match["block"])
            return self._recorded(rule, self.sites[site], block, shape, ran=ran)
        if ran:
            self._problem(f"no rule names the call of module '{shape.module}' ({shape.kind})")
        return None

    def _recorded(
        self, rule: CallRule, site: RecordedSite, block: int, shape: CallShape, *, ran: bool
    ) -> CallPlace | None:
        if block not in self.blocks(site):
            self._problem(f"module '{shape.module}' is block {block}, which site '{site.name}' does not have")
            return None
        step = self.fired[site.name, block]
        self.fired[site.name, block] += ran
        try:
            queries = slice(*site.queries(shape.queries))
        except BadArgument as error:
            self._problem(str(error).rstrip("."))
            return None
        fitted = self._keys(site, shape.keys, step if self.layout.autoregressive else 0)
        if fitted is None:
            return None
        keys = fitted if len(fitted) < site.keys.num_keys else None
        present = self.present.setdefault(site.name, np.zeros(site.keys.num_keys, dtype=bool))
        present[fitted] = True
        return CallPlace(rule, site.name, block, step, queries, keys)

    def _keys(self, site: RecordedSite, count: int, token: int) -> NDArray[np.int64] | None:
        """The site's keys that a call with `count` keys has; `token`: number of tokens generated before it."""
        spans = site.keys.spans
        lengths = {span.name: span.num_keys for span in spans}
        for span in spans:
            if getattr(span, "growing", False):
                lengths[span.name] = min(token + getattr(span, "growing_offset", 0), span.num_keys)
        if site.variable_span is not None:
            others = sum(length for name, length in lengths.items() if name != site.variable_span)
            longest = site.keys.span(site.variable_span).num_keys
            given = count - others
            if not 0 <= given <= longest:
                self._problem(
                    f"a call of site '{site.name}' has {count} keys, which leaves {given} for the span "
                    f"'{site.variable_span}' of 0 to {longest}"
                )
                return None
            if self._variable.setdefault(site.name, given) != given:
                self._problem(
                    f"the span '{site.variable_span}' of site '{site.name}' has {self._variable[site.name]} keys in "
                    f"one call and {given} in another"
                )
                return None
            lengths[site.variable_span] = given
        elif sum(lengths.values()) != count:
            expected = " + ".join(f"{lengths[span.name]} {span.name}" for span in spans)
            self._problem(
                f"a call of site '{site.name}' has {count} keys; the layout has {sum(lengths.values())} ({expected})"
            )
            return None
        return np.concatenate(
            [np.arange(span.start, span.start + lengths[span.name], dtype=np.int64) for span in spans]
        )

    def blocks(self, site: RecordedSite) -> tuple[int, ...]:
        """The blocks that have the site."""
        return tuple(getattr(site.keys, "layers", ())) or tuple(range(self.layout.num_layers))

    def _problem(self, sentence: str) -> None:
        self.problems[sentence] = None

    def check(self, where: str) -> None:
        """Raise `CallsDoNotFit` unless all calls fit and every block of every site computed as often as it should."""
        problems = [*self.problems, *self._missing()]
        if problems:
            raise CallsDoNotFit(
                f"The attention calls at {where} do not fit the layout '{self.layout.name}': "
                f"{listing_of_sentences(problems)}. Change the layout's rules and sites to the calls, which were:\n"
                f"{CallTable(self.policy, tuple(self.seen))}"
            )

    def _missing(self) -> Iterator[str]:
        for site in self.layout.sites:
            times = {block: self.fired[site.name, block] for block in self.blocks(site)}
            if not any(times.values()):
                yield (
                    f"the site '{site.name}' did not fire (compiled code, flash-attn and other extensions cannot be "
                    "seen: load the model with attn_implementation='sdpa' or 'eager')"
                )
                continue
            if self.layout.autoregressive:
                yield from self._missing_tokens(site, times)
                continue
            expected = self.layout.num_denoise_steps
            wrong = {block: count for block, count in times.items() if count != expected}
            if wrong:
                given = listing(f"block {block}: {count}" for block, count in wrong.items())
                yield (
                    f"the blocks of site '{site.name}' must compute {expected} times a policy call, once in each "
                    f"denoise step, but did otherwise ({given})"
                )

    def _missing_tokens(self, site: RecordedSite, times: dict[int, int]) -> Iterator[str]:
        counts, expected = set(times.values()), self.layout.num_action_tokens
        few_are_fine = self.layout.stops_early and max(counts) <= expected
        if len(counts) > 1 or not (counts == {expected} or few_are_fine):
            given = listing(f"block {block}: {count}" for block, count in times.items())
            yield (
                f"the blocks of site '{site.name}' must compute {'at most ' if self.layout.stops_early else ''}"
                f"{expected} times a policy call, once for each generated token, but did otherwise ({given})"
            )


def listing_of_sentences(problems: Sequence[str], limit: int = 6) -> str:
    """Join problems for a message: at most `limit` of them, then how many more there are."""
    more = f"; and {len(problems) - limit} more" if len(problems) > limit else ""
    return "; ".join(problems[:limit]) + more
