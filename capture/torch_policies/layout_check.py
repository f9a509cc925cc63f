"""`va.check_layout`: whether what a user changes in a policy call reaches the keys that the layout names for it.

The keys are looked at where the attention calls of the first block get them, before any block has mixed them. Values
are compared, which hold what a token is; keys may have its position in them, too.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vla_attention.capture.interventions.resolution import run_vocabularies, site_tokens
from vla_attention.capture.policies.random_numbers import RandomNumbers
from vla_attention.capture.torch_policies.attention_calls import AttentionCall
from vla_attention.capture.torch_policies.call_order import CallOrder, CallPlace, KnownCalls
from vla_attention.capture.torch_policies.inspect_calls import NoAttention, aligned
from vla_attention.capture.torch_policies.policy_layout import PolicyLayout, RecordedSite, check_is_layout
from vla_attention.capture.torch_policies.policy_modules import find_policy
from vla_attention.capture.torch_policies.prompts import TokenText
from vla_attention.capture.torch_policies.replan_inputs import ReplanInputs
from vla_attention.capture.torch_policies.replan_text import PromptIds, ReplanText, embeddings_of
from vla_attention.capture.torch_policies.unseen_attention import no_attention
from vla_attention.capture.torch_policies.watch import watch_attention
from vla_attention.schemas.errors import BadArgument, listing, runs_of
from vla_attention.schemas.groupings.selector_parser import atoms_of, parse_selector
from vla_attention.schemas.groupings.selector_weights import selector_weights
from vla_attention.schemas.layout import Span

#: Largest difference of a key's values, relative to the largest of them, that rounding leaves, by dtype: a prompt of
#: another length makes other kernels run.
_ROUNDING = {"float32": 1e-5, "float64": 1e-5, "float16": 5e-3, "bfloat16": 2e-2}
#: Selectors that need the prompt's text.
_OF_WORDS = ("word", "words")


class NotRepeatable(BadArgument):
    """A policy call that gives its attention other keys when it is made again."""


@dataclass(frozen=True)
class KeysMoved:
    """Which keys of one site moved when one thing was changed.

    Attributes:
        selector: the keys that should move, in the grouping language.
        site, block: where they were looked at.
        expected, moved: (key,) numbers of the site's keys, ascending.
        present: (key,) numbers of the keys that the calls have.
        spans: the site's.
    """

    selector: str
    site: str
    block: int
    expected: tuple[int, ...]
    moved: tuple[int, ...]
    present: tuple[int, ...]
    spans: tuple[Span, ...]

    @property
    def fits(self) -> bool:
        """Whether exactly the expected keys moved."""
        return self.expected == self.moved

    def named(self, keys: Sequence[int]) -> str:
        """Return keys in words: spans by name, and parts of spans with the numbers of their keys."""
        words = []
        for span in self.spans:
            in_span = [key for key in keys if span.start <= key < span.stop]
            if in_span:
                whole = len(in_span) == sum(span.start <= key < span.stop for key in self.present)
                runs = [str(run[0]) if len(run) == 1 else f"{run[0]}..{run[-1]}" for run in runs_of(in_span)]
                part = f" ({'key' if len(in_span) == 1 else 'keys'} {listing(runs)})"
                words.append(span.name + part * (not whole))
        return ", ".join(words) or "nothing"

    @property
    def verdict(self) -> str:
        """What is wrong, in words, or "yes"."""
        missing = self.named(sorted(set(self.expected) - set(self.moved)))
        beside = self.named(sorted(set(self.moved) - set(self.expected)))
        wrong = [f"{missing} did not move"] * (missing != "nothing") + [f"{beside} moved"] * (beside != "nothing")
        return f"no: {'; '.join(wrong)}" if wrong else "yes"


@dataclass(frozen=True)
class LayoutCheck:
    """What moved and what should have, for every change; printed, it is a table.

    Attributes:
        layout: the layout's name.
        changes: one for every change and site.
        left_out: the sites that were not looked at, because earlier blocks have mixed their keys.
    """

    layout: str
    changes: tuple[KeysMoved, ...]
    left_out: tuple[str, ...] = ()

    @property
    def fits(self) -> bool:
        """Whether every change moved exactly the keys that the layout names for it."""
        return all(change.fits for change in self.changes)

    def __str__(self) -> str:
        lines = [("changed", "site", "should move", "moved", "fits")]
        lines += [
            (moved.selector, moved.site, moved.named(moved.expected), moved.named(moved.moved), moved.verdict)
            for moved in self.changes
        ]
        text = aligned(lines)
        wrong = sum(not change.fits for change in self.changes)
        found = f"{wrong} of {len(self.changes)} do not fit" if wrong else "every change moves its keys and no others"
        blocks = dict.fromkeys(f"'{moved.site}' at block {moved.block}" for moved in self.changes)
        text.insert(0, f"Layout '{self.layout}', keys of {' and '.join(blocks)}: {found}")
        if self.left_out:
            text.append(
                f"Not looked at: {listing(self.left_out)}, whose first block comes after others that mix the keys "
                "(site=... does)."
            )
        return "\n".join(text)

    __repr__ = __str__


def check_layout(
    policy: object,
    call: Callable[[], object],
    layout: PolicyLayout,
    perturb: Mapping[str, Callable[[], object]],
    *,
    tokenizer: Any = None,
    instruction: str = "",
    site: str | None = None,
) -> LayoutCheck:
    """Return whether a change of a policy's input moves exactly the keys that the layout names for it.

    >>> import vla_attention as va
    >>> check = va.check_layout(policy, lambda: policy.act(**batch), layout, {
    ...     "camera:front": lambda: policy.act(**{**batch, "pictures": 1 - batch["pictures"]}),
    ...     "span:state": lambda: policy.act(**{**batch, "states": batch["states"] + 1}),
    ... })
    >>> check.fits
    True

    The keys are looked at in the first block of a policy call, at the first denoise step, before anything but the
    policy's own encoders has mixed them: what a text encoder mixes moves together, and is named together, as
    `"camera:front | span:prompt"`.

    Args:
        policy, layout: as in `va.record`.
        call: makes the policy call, for one environment; it can be repeated, and is made with the same random numbers.
        perturb: keys in the grouping language (`camera:front`, `span:state`, `word:bowl`, `role:instruction`,
            `patch:front[0:1,0:1]`) -> the same policy call with that alone changed which they hold. A picture must
            change in every patch that is named, and a word be exchanged by one of as many tokens.
        tokenizer, instruction: for words; the policy's own tokenizer, and the task as the policy reads it.
        site: look at this site, at its first block; None: at every site that the policy's first block has.

    Raises:
        CallsDoNotFit: the attention calls are not those of the layout.
        NotRepeatable: keys move although nothing was changed.
        SelectorError: a name that the layout does not have.
        BadArgument: keys of the layout that the call does not have, or words without a tokenizer.
    """
    check_is_layout(layout)
    if not perturb:
        raise BadArgument("va.check_layout got no changes; expected a dictionary from keys to policy calls.")
    for selector in perturb:
        if tokenizer is None and any(atom.kind in _OF_WORDS for atom in atoms_of(parse_selector(selector))):
            raise BadArgument(f"'{selector}' needs tokenizer= and instruction=, which say where the words are.")
    firsts = {known.name: min(known.keys.layers, default=0) for known in layout.sites}
    blocks = {name: block for name, block in firsts.items() if block == min(firsts.values())}
    if site is not None:
        blocks = {site: firsts[layout.site(site).name]}
    found, random, changes = find_policy(policy), RandomNumbers(), []
    embeddings = embeddings_of(found.modules, layout)

    def keys_of(call: Callable[[], object], what: str) -> _Keys:
        random.again()
        keys = _Keys(layout, type(found.policy).__name__, blocks, PromptIds(embeddings, batch=1))
        with keys.ids.watched(), watch_attention(found, keys):
            call()
        if not keys.ran:
            raise NoAttention(f"In {what}: {no_attention(found.policy, keys.unmet)}")
        keys.check(what)
        return keys

    try:
        keys = keys_of(call, "the unchanged call")
        expected = keys.expected(perturb, None if tokenizer is None else TokenText(tokenizer), instruction)
        keys.check_repeats(keys_of(call, "the unchanged call, made again"))
        for selector, changed_call in perturb.items():
            changed = keys_of(changed_call, f"the call for '{selector}'")
            for name, block in blocks.items():
                masks = expected[selector][name], keys.moved(changed, name), keys.there(name) | changed.there(name)
                wanted, moved, present = (tuple(int(key) for key in np.flatnonzero(mask)) for mask in masks)
                if wanted or moved:
                    spans = layout.site(name).keys.spans
                    changes.append(KeysMoved(selector, name, block, wanted, moved, present, spans))
    finally:
        random.again()
    left_out = tuple(name for name in firsts if name not in blocks) if site is None else ()
    return LayoutCheck(layout.name, tuple(changes), left_out)


class _Keys(CallOrder):
    """Keeps the values of the first call of some sites' first blocks, and what tells their words.

    values: site -> (key, number), NaN for keys that the call does not have. valid: site -> (key,) bool, keys that some
    action query may see. rounding: site -> see `_ROUNDING`.
    """

    def __init__(self, layout: PolicyLayout, policy: str, blocks: Mapping[str, int], ids: PromptIds) -> None:
        super().__init__(KnownCalls(layout), policy)
        self.blocks, self.ids = blocks, ids
        self.values: dict[str, NDArray[np.float32]] = {}
        self.valid: dict[str, NDArray[np.bool_]] = {}
        self.rounding: dict[str, float] = {}

    def wanted(self, place: CallPlace) -> bool:
        return place.site not in self.values and self.blocks.get(place.site or "") == place.block

    def take(self, call: AttentionCall, place: CallPlace, site: RecordedSite) -> None:
        if call.shape.batch != 1:
            raise BadArgument(
                f"A call of site '{site.name}' has a batch of {call.shape.batch}; give va.check_layout policy calls "
                "for one environment."
            )
        count = site.keys.num_keys
        positions = slice(None) if place.keys is None else place.keys
        numbers = call.value[0].detach().transpose(0, 1).flatten(1).float().cpu().numpy()
        self.values[site.name] = values = np.full((count, numbers.shape[1]), np.nan, dtype=np.float32)
        values[positions] = numbers
        self.valid[site.name] = valid = np.zeros(count, dtype=bool)
        valid[positions] = call.allowed(place.queries)[0].any(dim=(0, 1)).cpu().numpy()
        self.rounding[site.name] = _ROUNDING.get(call.precision, _ROUNDING["float32"])

    def there(self, site: str) -> NDArray[np.bool_]:
        """(key,) bool, the keys that the call has."""
        there: NDArray[np.bool_] = np.logical_not(np.isnan(self.values[site]).all(axis=1))
        return there

    def moved(self, other: _Keys, site: str) -> NDArray[np.bool_]:
        """(key,) bool, the keys of a site that another call has otherwise, or that one of the calls lacks."""
        before, after = np.nan_to_num(self.values[site]), np.nan_to_num(other.values[site])
        scale = np.maximum(np.abs(before).max(axis=1), np.abs(after).max(axis=1))
        moved: NDArray[np.bool_] = np.greater(np.abs(before - after).max(axis=1), self.rounding[site] * scale)
        moved |= self.there(site) != other.there(site)
        return moved

    def expected(
        self, selectors: Mapping[str, object], tokenizer: TokenText | None, instruction: str
    ) -> dict[str, dict[str, NDArray[np.bool_]]]:
        """Return selector -> site -> (key,) bool, the keys that it takes of those that the call has."""
        inputs = {0: ReplanInputs(env_step=0, instruction=instruction)}
        text = ReplanText(self.layout, tokenizer, self.ids, inputs, self.present)
        prompt = text.prompt(0, {})
        sites = [self.known.sites[name] for name in self.values]
        roles = {site.name: text.roles(0, site, prompt, self.valid[site.name]) for site in sites}
        layouts = [site.keys for site in sites]
        tokens = site_tokens(layouts, roles, prompt, (), {})
        vocabularies = run_vocabularies(layouts, [prompt.instruction_text], ())
        chosen = {}
        for selector in selectors:
            weights = selector_weights(selector, tokens, vocabularies)
            chosen[selector] = {name: (weights[name][0] > 0) & self.there(name) for name in self.values}
            if not any(keys.any() for keys in chosen[selector].values()):
                raise BadArgument(
                    f"'{selector}' takes no key that the policy call has at {listing(self.values)}; the spans there "
                    f"are {listing(span.name for site in sites for span in site.keys.spans)}."
                )
        return chosen

    def check_repeats(self, again: _Keys) -> None:
        """Raise `NotRepeatable` if keys move between two calls in which nothing was changed."""
        for name in self.values:
            moved = self.moved(again, name)
            spans = [span.name for span in self.known.sites[name].keys.spans if moved[span.start : span.stop].any()]
            if spans:
                raise NotRepeatable(
                    f"The keys of the spans {listing(spans)} at site '{name}' are others when the unchanged call is "
                    "made again, with the same random numbers of torch. Give the policy its noise, or reset it in each "
                    "call, as lambda: (policy.reset(), policy.select_action(batch))[1]."
                )
