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
from vla_attention.capture.torch_policies.inspect_calls import CallTable, folded_paths
from vla_attention.capture.torch_policies.key_caches import LOAD_WITH_DYNAMIC_CACHE
from vla_attention.capture.torch_policies.policy_layout import PolicyLayout, RecordedSite
from vla_attention.schemas.errors import BadArgument, UserError, listing


class CallsDoNotFit(UserError, ValueError):
    """The attention calls of a policy are not those of its layout. The message ends with a table of the calls."""

    has_lines = True


@dataclass(frozen=True)
class CallPlace:
    """What one call is.

    rule: the number of its rule. site, block: None and -1 for calls that have none, or do not fit. step: the denoise
    step; of an autoregressive policy the number of the generated token. queries: positions of the action queries. keys:
    (key of the call,) the site's key of each key of the call, None where they are the same. fired: site and block of a
    call that counts, also if it does not fit.
    """

    rule: int
    site: str | None = None
    block: int = -1
    step: int = -1
    queries: slice = field(default_factory=lambda: slice(0))
    keys: NDArray[np.int64] | None = None
    fired: tuple[str, int] | None = None


class KnownCalls:
    """What was found out about calls of a layout: the same for all replans of a run, and looked up at every call."""

    def __init__(self, layout: PolicyLayout) -> None:
        self.layout = layout
        self.sites = {site.name: site for site in layout.sites}
        self.blocks = {site.name: site.keys.layers or tuple(range(layout.num_layers)) for site in layout.sites}
        #: (site, number of keys, token) -> (the site's keys of such a call, the length of its variable span).
        self.keys: dict[tuple[str, int, int], tuple[NDArray[np.int64], int]] = {}
        self._rules: dict[tuple[str, str, int, int], tuple[int, int | None]] = {}
        self._queries: dict[tuple[str, int], slice] = {}

    def rule(self, shape: CallShape) -> tuple[int, int | None]:
        """Return the number of a call's rule, -1 for none, and of the block in its module's path, if that names one."""
        call = shape.module, shape.kind, shape.queries, shape.keys
        rule_and_block = self._rules.get(call)
        if rule_and_block is None:
            rule_and_block = -1, None
            for number, rule in enumerate(self.layout.rules):
                match = rule.fits(*call)
                if match is not None:
                    rule_and_block = number, rule.block(match) if rule.site is not None else None
                    break
            self._rules[call] = rule_and_block
        return rule_and_block

    def queries(self, site: RecordedSite, count: int) -> slice:
        """Return the action queries of a call with `count` queries; errors as `RecordedSite.queries`."""
        queries = self._queries.get((site.name, count))
        if queries is None:
            queries = self._queries[site.name, count] = slice(*site.queries(count))
        return queries


class CallOrder:
    """Gives the calls of one replan their places, one after the other. Every replan needs a new one."""

    def __init__(self, known: KnownCalls, policy: str) -> None:
        self.known = known
        self.layout = known.layout
        self.policy = policy
        self.seen: list[CallShape] = []
        self.problems: dict[str, None] = {}
        self.fired: Counter[tuple[str, int]] = Counter()
        self.calls_of_rule: Counter[int] = Counter()
        #: Site -> (key,) bool: the keys that some call had.
        self.present: dict[str, NDArray[np.bool_]] = {}
        self._variable: dict[str, int] = {}
        #: Kind, queries and keys of calls that no rule names -> their modules.
        self._unnamed: dict[tuple[str, int, int], dict[str, None]] = {}
        self._noted: set[tuple[str, int, int]] = set()
        #: Whether an autoregressive policy made fewer tokens than planned, in every block as many.
        self.fewer_tokens = False

    def place(self, shape: CallShape) -> CallPlace | None:
        """Return what the next call is, or None if it does not fit.

        Nothing is counted before `ran`: a softmax may turn out not to be attention.
        """
        number, block = self.known.rule(shape)
        if number < 0:
            return None
        rule = self.layout.rules[number]
        if rule.sequence:
            name, block = rule.sequence[self.calls_of_rule[number] % len(rule.sequence)]
        elif rule.site is None:
            return CallPlace(number)
        else:
            name = rule.site
        if block is None:
            self._problem(
                f"the group (?P<block>...) of the rule '{rule.modules}' is no number in the path of module "
                f"'{shape.module}'; let it match the block's digits only"
            )
            return CallPlace(number)
        site = self.known.sites[name]
        if block not in self.known.blocks[name]:
            self._problem(f"module '{shape.module}' is block {block}, which site '{name}' does not have")
            return CallPlace(number)
        step = self.fired[name, block]
        try:
            queries = self.known.queries(site, shape.queries)
        except BadArgument as error:
            self._problem(str(error).rstrip("."))
            return CallPlace(number, fired=(name, block))
        fitted = self._keys_of(site, shape.keys, step if self.layout.autoregressive else 0)
        if fitted is None:
            return CallPlace(number, fired=(name, block))
        keys = fitted if len(fitted) < site.keys.num_keys else None
        return CallPlace(number, name, block, step, queries, keys, (name, block))

    def ran(self, shape: CallShape, place: CallPlace | None) -> None:
        """Count a call that has run; `place`: what `place` returned for it."""
        self.seen.append(shape)
        if place is None:
            self._unnamed.setdefault((shape.kind, shape.queries, shape.keys), {})[shape.module] = None
            return
        self.calls_of_rule[place.rule] += 1
        if place.fired is not None:
            self.fired[place.fired] += 1

    def _keys_of(self, site: RecordedSite, count: int, token: int) -> NDArray[np.int64] | None:
        call = site.name, count, token
        known_keys = self.known.keys.get(call)
        if known_keys is None or (site.variable_span is not None and self._variable.get(site.name) != known_keys[1]):
            fitted = self._keys(site, count, token)
            if fitted is None:
                if self.layout.autoregressive:
                    self._problem(
                        f"static and sliding caches have keys that a layout cannot name: {LOAD_WITH_DYNAMIC_CACHE}"
                    )
                return None
            known_keys = self.known.keys[call] = fitted, self._variable.get(site.name, 0)
        if call not in self._noted:
            self._noted.add(call)
            present = self.present.setdefault(site.name, np.zeros(site.keys.num_keys, dtype=bool))
            present[known_keys[0]] = True
        return known_keys[0]

    def _keys(self, site: RecordedSite, count: int, token: int) -> NDArray[np.int64] | None:
        """The site's keys that a call with `count` keys has; `token`: number of tokens generated before it."""
        spans = site.keys.spans
        lengths = {span.name: span.num_keys for span in spans}
        for span in spans:
            if span.growing:
                lengths[span.name] = min(token + span.growing_offset, span.num_keys)
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

    def _problem(self, sentence: str) -> None:
        self.problems[sentence] = None

    def check(self, where: str) -> None:
        """Raise `CallsDoNotFit` unless all calls fit and every block of every site computed as often as it should."""
        unnamed = [
            f"no rule names the calls of module '{folded_paths(list(modules))}' ({kind}, {queries} x {keys})"
            for (kind, queries, keys), modules in self._unnamed.items()
        ]
        problems = [*unnamed, *self.problems, *self._missing()]
        if problems:
            raise CallsDoNotFit(
                f"The attention calls at {where} do not fit the layout '{self.layout.name}': "
                f"{listing_of_sentences(problems)}. Change the layout's rules and sites to the calls, which were:\n"
                f"{CallTable(self.policy, tuple(self.seen))}"
            )

    def _missing(self) -> Iterator[str]:
        for site in self.layout.sites:
            times = {block: self.fired[site.name, block] for block in self.known.blocks[site.name]}
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
                several = len(wrong) == len(times) and all(count % expected == 0 for count in times.values())
                more = (
                    "; a replan block holds one policy call, and blocks that run several times in a denoise step are "
                    "named by a rule with a sequence" * several
                )
                yield (
                    f"the blocks of site '{site.name}' must compute {expected} times a policy call, once in each "
                    f"denoise step, but did otherwise ({given}){more}"
                )

    def _missing_tokens(self, site: RecordedSite, times: dict[int, int]) -> Iterator[str]:
        counts, expected = set(times.values()), self.layout.num_action_tokens
        few_are_fine = self.layout.stops_early and max(counts) <= expected
        if len(counts) > 1 or not (counts == {expected} or few_are_fine):
            given = listing(f"block {block}: {count}" for block, count in times.items())
            self.fewer_tokens = max(counts) < expected and len(counts) == 1
            yield (
                f"the blocks of site '{site.name}' must compute {'at most ' if self.layout.stops_early else ''}"
                f"{expected} times a policy call, once for each generated token, but did otherwise ({given})"
                f"{'; stops_early=True is for policies that may generate fewer' * self.fewer_tokens}"
            )


def listing_of_sentences(problems: Sequence[str], limit: int = 6) -> str:
    """Join problems for a message: at most `limit` of them, then how many more there are."""
    more = f"; and {len(problems) - limit} more" if len(problems) > limit else ""
    return "; ".join(problems[:limit]) + more
