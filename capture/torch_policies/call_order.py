"""Which site, block and denoise step each attention call of a replan is, and what does not fit the layout.

What does not fit is kept and raised at the end of the replan, so that the error can show all calls.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from functools import cache

import numpy as np
from numpy.typing import NDArray

from vla_attention.capture.torch_policies.attention_calls import AttentionCall, CallShape, Watcher
from vla_attention.capture.torch_policies.inspect_calls import CallTable, folded_paths
from vla_attention.capture.torch_policies.key_caches import LOAD_WITH_DYNAMIC_CACHE
from vla_attention.capture.torch_policies.output_ways import OutputWay
from vla_attention.capture.torch_policies.policy_layout import PolicyLayout, RecordedSite
from vla_attention.schemas.errors import BadArgument, UserError, listing


class CallsDoNotFit(UserError, ValueError):
    """The attention calls of a policy are not those of its layout. The message ends with a table of the calls."""

    has_lines = True


#: How many problems a message names.
_SHOWN = 6
#: Of the keys of an autoregressive policy that are not those of the layout.
_ODD_CACHE = f"static and sliding caches have keys that a layout cannot name: {LOAD_WITH_DYNAMIC_CACHE}"


@dataclass(frozen=True)
class CallPlace:
    """What one call is.

    rule: the number of its rule. site, block: None and -1 for calls that have none, or do not fit. step: the denoise
    step; of an autoregressive policy the number of the generated token. queries: positions of the action queries. keys:
    (key of the call,) the site's key of each key of the call, None where they are the same. fired: site and block of a
    call that counts, also if it does not fit. problems: why it does not fit.
    """

    rule: int
    site: str | None = None
    block: int = -1
    step: int = -1
    queries: slice = field(default_factory=lambda: slice(0))
    keys: NDArray[np.int64] | None = None
    fired: tuple[str, int] | None = None
    problems: tuple[str, ...] = ()


class KnownCalls:
    """What was found out about calls of a layout: the same for all replans of a run, and looked up at every call.

    Attributes:
        rule: of the module, kind, queries and keys of a call, the number of its rule, -1 for none, and of the block in
            its module's path, if that names one.
        queries: of a site and a number of queries, the action queries; errors as `RecordedSite.queries`.
        keys: of a site, a number of keys and a number of tokens generated before, the site's keys of such a call, and
            the length of its variable span; instead of the keys, what does not fit.
        compared: shapes of calls, without their numbers, of which rows were compared with what the kernel gave.
        sums: by site and block, which of the sums with what attention gave is the residual stream, from 1; where it
            was the same one in all calls that were watched throughout.
        asked_of_queries: sites of which it was looked at whether their queries are action tokens.
    """

    def __init__(self, layout: PolicyLayout) -> None:
        self.layout = layout
        self.sites = {site.name: site for site in layout.sites}
        self.compared: set[CallShape] = set()
        self.sums: dict[tuple[str, int], int] = {}
        self.asked_of_queries: set[str] = set()
        self._unlike: set[tuple[str, int]] = set()
        self.blocks = {site.name: site.keys.layers or tuple(range(layout.num_layers)) for site in layout.sites}
        self.rule, self.keys = cache(self._rule), cache(self._keys)
        self.queries = cache(lambda site, count: slice(*self.sites[site].queries(count)))

    def learn_sums(self, sums: Mapping[tuple[str, int], int | None]) -> None:
        """Keep which sums were the stream in a call that was watched throughout; None: it is not known."""
        for block, number in sums.items():
            if number is None or self.sums.get(block, number) != number:
                self._unlike.add(block)
            else:
                self.sums[block] = number
        for block in self._unlike:
            self.sums.pop(block, None)

    def _rule(self, module: str, kind: str, queries: int, keys: int) -> tuple[int, int | None]:
        for number, rule in enumerate(self.layout.rules):
            match = rule.fits(module, kind, queries, keys)
            if match is not None:
                # The group may be no number, or not match.
                digits = match["block"] or "" if rule.site is not None else ""
                return number, int(digits) if digits.isdecimal() else None
        return -1, None

    def _keys(self, name: str, count: int, token: int) -> tuple[NDArray[np.int64] | str, int]:
        site = self.sites[name]
        lengths = {
            span.name: min(token + span.growing_offset, span.num_keys) if span.growing else span.num_keys
            for span in site.keys.spans
        }
        given, variable = 0, site.variable_span
        if variable is not None:
            longest = site.keys.span(variable).num_keys
            given = lengths[variable] = count - sum(lengths.values()) + lengths[variable]
            if not 0 <= given <= longest:
                return (
                    f"a call of site '{name}' has {count} keys, which leaves {given} for the span '{variable}' of 0 to "
                    f"{longest}",
                    given,
                )
        elif sum(lengths.values()) != count:
            expected = " + ".join(f"{length} {span}" for span, length in lengths.items())
            return f"a call of site '{name}' has {count} keys; the layout has {sum(lengths.values())} ({expected})", 0
        parts = [np.arange(span.start, span.start + lengths[span.name], dtype=np.int64) for span in site.keys.spans]
        return np.concatenate(parts), given


class CallOrder(Watcher):
    """Gives the calls of one replan their places, one after the other, and takes some. Every replan needs a new one.

    Who takes calls says which, with `wanted` and `take`.
    """

    def __init__(self, known: KnownCalls, policy: str) -> None:
        self.known = known
        self.layout = known.layout
        self.policy = policy
        self.ran: list[CallShape] = []
        self.problems: dict[str, None] = {}
        self.fired: Counter[tuple[str, int]] = Counter()
        self.calls_of_rule: Counter[int] = Counter()
        #: Site -> (key,) bool: the keys that some call had.
        self.present: dict[str, NDArray[np.bool_]] = {}
        self._variable: dict[str, int] = {}
        #: Kind, queries and keys of calls that no rule names -> their modules.
        self._unnamed: dict[tuple[str, int, int], dict[str, None]] = {}
        self._noted: set[tuple[str, int, int]] = set()

    def place(self, shape: CallShape) -> CallPlace | None:
        """Return what the next call is, or None if no rule names it.

        Nothing is counted before it ran: a softmax may turn out not to be attention.
        """
        number, block = self.known.rule(shape.module, shape.kind, shape.queries, shape.keys)
        if number < 0:
            return None
        rule, name = self.layout.rules[number], self.layout.rules[number].site
        if rule.sequence:
            name, block = rule.sequence[self.calls_of_rule[number] % len(rule.sequence)]
        if name is None:
            return CallPlace(number)
        if block is None:
            problem = (
                f"the group (?P<block>...) of the rule '{rule.modules}' is no number in the path of module "
                f"'{shape.module}'; let it match the block's digits only"
            )
            return CallPlace(number, problems=(problem,))
        if block not in self.known.blocks[name]:
            problem = f"module '{shape.module}' is block {block}, which site '{name}' does not have"
            return CallPlace(number, problems=(problem,))
        step = self.fired[name, block]
        try:
            queries = self.known.queries(name, shape.queries)
        except BadArgument as error:
            return CallPlace(number, fired=(name, block), problems=(str(error).rstrip("."),))
        keys = self._keys_of(name, shape.keys, step if self.layout.autoregressive else 0)
        if isinstance(keys, str):
            return CallPlace(number, fired=(name, block), problems=(keys, *[_ODD_CACHE] * self.layout.autoregressive))
        all_keys = len(keys) == self.known.sites[name].keys.num_keys
        return CallPlace(number, name, block, step, queries, None if all_keys else keys, (name, block))

    def wanted(self, place: CallPlace) -> bool:
        """Return whether a call of a site is taken."""
        return False

    def take(self, call: AttentionCall, place: CallPlace, site: RecordedSite) -> OutputWay | None:
        """Take a call that is wanted, right after its kernel. Return whether its output is followed."""

    def passes(self, shape: CallShape) -> bool:
        """See `Watcher`; a call that is not wanted is counted here."""
        place = self.place(shape)
        if place is not None and place.site is not None and self.wanted(place):
            return False
        self._count(shape, place)
        return True

    def sinks(self, shape: CallShape) -> int:
        """See `Watcher`."""
        place = self.place(shape)
        return 0 if place is None or place.site is None else self.known.sites[place.site].sinks

    def saw(self, call: AttentionCall) -> OutputWay | None:
        """See `Watcher`."""
        place = self.place(call.shape)
        self._count(call.shape, place)
        assert place is not None
        assert place.site is not None
        return self.take(call, place, self.known.sites[place.site])

    def _count(self, shape: CallShape, place: CallPlace | None) -> None:
        self.ran.append(shape)
        if place is None:
            self._unnamed.setdefault((shape.kind, shape.queries, shape.keys), {})[shape.module] = None
            return
        self.problems.update(dict.fromkeys(place.problems))
        self.calls_of_rule[place.rule] += 1
        if place.fired is not None:
            self.fired[place.fired] += 1

    def _keys_of(self, site: str, count: int, token: int) -> NDArray[np.int64] | str:
        keys, given = self.known.keys(site, count, token)
        if isinstance(keys, str):
            return keys
        if self._variable.setdefault(site, given) != given:
            return (
                f"the span '{self.known.sites[site].variable_span}' of site '{site}' has {self._variable[site]} keys "
                f"in one call and {given} in another"
            )
        if (site, count, token) not in self._noted:
            self._noted.add((site, count, token))
            self.present.setdefault(site, np.zeros(self.known.sites[site].keys.num_keys, dtype=bool))[keys] = True
        return keys

    def check(self, where: str) -> None:
        """Raise `CallsDoNotFit` unless all calls fit and every block of every site computed as often as it should."""
        unnamed = [
            f"no rule names the calls of module '{folded_paths(list(modules))}' ({kind}, {queries} x {keys})"
            for (kind, queries, keys), modules in self._unnamed.items()
        ]
        problems = [*unnamed, *self.problems, *self._missing()]
        more = f"; and {len(problems) - _SHOWN} more" if len(problems) > _SHOWN else ""
        if problems:
            raise CallsDoNotFit(
                f"The attention calls at {where} do not fit the layout '{self.layout.name}': "
                f"{'; '.join(problems[:_SHOWN])}{more}. Change the layout's rules and sites to the calls, which were:\n"
                f"{CallTable(self.policy, tuple(self.ran))}"
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
            fewer_tokens = max(counts) < expected and len(counts) == 1
            yield (
                f"the blocks of site '{site.name}' must compute {'at most ' if self.layout.stops_early else ''}"
                f"{expected} times a policy call, once for each generated token, but did otherwise ({given})"
                f"{'; stops_early=True is for policies that may generate fewer' * fewer_tokens}"
            )
