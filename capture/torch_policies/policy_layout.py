"""A policy's layout: which attention calls it makes, what their queries and keys are. Plain data, no torch.

A `PolicyLayout` is written by hand or by an adapter, stored with the run, and checked against the calls that a policy
makes: `call_order.py` gives each call its site, block and denoise step, and says what does not fit.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from typing import Literal

from msgspec import field

from vla_attention.schemas.errors import BadArgument, UserError, listing, unknown_name
from vla_attention.schemas.jsonable import Document, Number
from vla_attention.schemas.layout import (
    ROLES_OF_KIND,
    Role,
    SiteLayout,
    Span,
    find_role,
    kinds_and_roles,
    picture_size,
)
from vla_attention.schemas.safe_text import check_name, check_text

#: How a picture becomes the model's input image: its sides stretched; padded on two sides; padded left and on top only.
PictureFit = Literal["stretch", "pad", "pad_left_top"]

#: What a key is called that no query of the call can see, by the kind of its span.
_MASKED_ROLE = {
    "image": Role.MASKED_IMAGE, "text": Role.PADDING, "latent": Role.MASKED_IMAGE,
}  # fmt: skip


class LayoutForAnotherVersion(UserError, RuntimeError):
    """A layout that was written for other versions of the libraries than those that are installed."""


class CallRule(Document, frozen=True):
    """What the attention calls of some modules are. Of a layout's rules, the first that fits a call names it.

    Attributes:
        modules: regular expression for the whole path of the innermost module that runs, from the recorded policy. A
            group `block` gives the block's number: ``model\\.layers\\.(?P<block>\\d+)\\.self_attn``.
        site: the site, or None for known calls without action queries (vision tower, text encoder, prefix pass).
        kind, queries, keys: further conditions on the call: its kind, and its numbers of queries and keys.
        sequence: where one module makes the calls of all blocks: (site, block) in the order of the calls of one denoise
            step. `site` is None then.
        tokens: the site whose first keys are queries and keys of these calls, token by token: with the site None a pass
            over the prefix; with a site, and the same one here, calls whose queries are all tokens. Effects for all
            queries need it: keys are cut off in these calls too.
    """

    modules: str
    site: str | None
    kind: str | None = None
    queries: int | None = None
    keys: int | None = None
    sequence: tuple[tuple[str, int], ...] = ()
    tokens: str | None = None

    def __post_init__(self) -> None:
        """Check the expression, and that site, block and sequence go together."""
        try:
            groups = re.compile(self.modules).groupindex
        except re.error as error:
            raise BadArgument(f"The rule '{self.modules}' is no regular expression: {error}.") from None
        for call in self.sequence:
            if not isinstance(call, tuple | list) or [*map(type, call)] != [str, int]:
                raise BadArgument(
                    f"The rule '{self.modules}' has {call!r} in its sequence; expected site and block of each call of "
                    "a denoise step, as ('self', 0). Calls without a site get a rule of their own before this one."
                )
        if self.site is not None and self.sequence:
            raise BadArgument(f"The rule '{self.modules}' has both a site and a sequence; give one of them.")
        if self.tokens is not None and (self.sequence or self.site not in (None, self.tokens)):
            raise BadArgument(
                f"The rule '{self.modules}' has the tokens of site '{self.tokens}': expected the site None (a pass "
                "over the prefix) or the same site, and no sequence."
            )
        if self.site is not None and "block" not in groups:
            raise BadArgument(
                f"The rule '{self.modules}' of site '{self.site}' does not say which block a call is of: expected a "
                r"group (?P<block>\d+), or a sequence."
            )

    @property
    def sites(self) -> tuple[str, ...]:
        """The sites that calls of this rule may have; none for calls that are not recorded."""
        return tuple(dict.fromkeys(site for site, _ in self.sequence)) or ((self.site,) if self.site else ())

    @property
    def is_prefix(self) -> bool:
        """Whether its calls are passes over the tokens of a site, before its action queries."""
        return self.tokens is not None and self.site is None

    def fits(self, module: str, kind: str, queries: int, keys: int) -> re.Match[str] | None:
        """Return the match of the module's path if the rule is for this call."""
        wanted = ((self.kind, kind), (self.queries, queries), (self.keys, keys))
        if any(condition is not None and condition != given for condition, given in wanted):
            return None
        return re.fullmatch(self.modules, module)


class RecordedSite(Document, frozen=True):
    r"""One family of softmaxes: its keys and its action queries.

    Attributes:
        keys: the spans, with grids; also the blocks (`layers`) that have the site, when others do not.
        action_queries: (start, stop) on the query axis of a call. Numbers below 0 count from the end, a stop of None
            is the end: (-50, None) are the last 50 queries.
        role_of_span: span -> role of its keys ("image", "instruction", "state", "action" ...), one that keys of its
            kind can have. Keys of the prompt get finer roles where token ids are known; keys that no action query may
            see become `masked_image` in image spans, `padding` in text, and `absent` in others.
        variable_span: the span that may have fewer keys in a call than in `keys` (a prompt without padding). Its keys
            come first in the span, the rest is absent at this replan.
        sinks: how many keys more its softmax has than there are values (trained sinks, as gpt-oss): they are the last
            ones of `keys`, in spans of the kind state with the role learned. A knockout leaves them.
    """

    keys: SiteLayout
    action_queries: tuple[int, int | None]
    role_of_span: dict[str, str]
    variable_span: str | None = None
    sinks: int = 0

    def __post_init__(self) -> None:
        """Check the names of spans and roles."""
        names = [span.name for span in self.keys.spans]
        for given in (*self.role_of_span, *([self.variable_span] if self.variable_span is not None else [])):
            if given not in names:
                raise unknown_name("span", given, names)
        missing = [name for name in names if name not in self.role_of_span]
        if missing:
            raise BadArgument(f"Site '{self.name}' says no role for the spans {listing(missing)}. {kinds_and_roles()}.")
        for span in self.keys.spans:
            self._check_role(span)
        start, stop = self.action_queries
        if stop is not None and (start < 0) == (stop < 0) and stop <= start:
            raise BadArgument(f"Site '{self.name}' has the action queries {start}..{stop}, which are none.")
        first_sink = self.keys.num_keys - self.sinks
        wrong = [span.name for span in self.keys.spans if span.stop > first_sink and self.role_of(span) != Role.LEARNED]
        within = any(span.start < first_sink < span.stop for span in self.keys.spans)
        if not 0 <= self.sinks < self.keys.num_keys or (self.sinks and (wrong or within)):
            raise BadArgument(
                f"Site '{self.name}' has {self.sinks} sinks; expected the last keys, in spans of their own of the kind "
                f"state with the role learned. Its spans: {listing(f'{s.name} {s.num_keys}' for s in self.keys.spans)}."
            )

    def _check_role(self, span: Span) -> None:
        """Raise an error unless the span's kind and the role that is given for its keys exist and fit together."""
        kind, role = span.kind, self.role_of_span[span.name]
        if kind not in ROLES_OF_KIND:
            wrong = f"there is no kind '{kind}'"
        elif str(role).casefold() not in [known.label for known in Role]:
            wrong = f"there is no role '{role}'"
        elif self.role_of(span) not in ROLES_OF_KIND[kind]:
            wrong = "they do not fit together"
        else:
            return
        raise BadArgument(
            f"Site '{self.name}' gives the span '{span.name}' the kind '{kind}' and the role '{role}': {wrong}. "
            f"{kinds_and_roles()}. Tokens that the policy itself adds, such as one for the time, registers and learned "
            "queries, are of the kind state with the role learned."
        )

    @property
    def name(self) -> str:
        """The site's name."""
        return self.keys.name

    def is_in(self, layers: Sequence[int]) -> bool:
        """Whether some of these layers have the site."""
        return not self.keys.layers or not set(self.keys.layers).isdisjoint(layers)

    @property
    def num_action_queries(self) -> int:
        """Number of action queries of a call; 0 where it depends on the call."""
        start, stop = self.action_queries
        if stop is None:
            return -start if start < 0 else 0
        return stop - start if (start < 0) == (stop < 0) else 0

    def queries(self, count: int) -> tuple[int, int]:
        """Return (start, stop) of the action queries of a call with `count` queries.

        Raises:
            BadArgument: the call has fewer queries.
        """
        start, stop, _ = slice(*self.action_queries).indices(count)
        first, last = self.action_queries
        wanted = [number for number in (first, last) if number is not None]
        if stop <= start or any(number > count or -number > count for number in wanted):
            raise BadArgument(
                f"Site '{self.name}' has the action queries {first}..{'' if last is None else last}, but the call has "
                f"{count} queries."
            )
        return start, stop

    def role_of(self, span: Span) -> Role:
        """Return the role of a span's keys."""
        return find_role(self.role_of_span[span.name])

    def masked_role(self, span: Span) -> Role:
        """Return the role of a span's keys that no action query may see."""
        return _MASKED_ROLE.get(span.kind, Role.ABSENT)


class CameraPicture(Document, frozen=True):
    """A camera of the policy, and how its picture becomes the model's input image.

    fit: `stretch` (sides resized one by one), `pad` (resized, padded evenly on two sides) or `pad_left_top` (padded on
    the left or on top only, as SmolVLA does).
    """

    name: str
    fit: PictureFit = "stretch"

    def __post_init__(self) -> None:
        """Check the name."""
        check_name("camera", self.name)


class PromptText(Document, frozen=True):
    """Where the prompt's token ids are seen, and which keys they are.

    Attributes:
        spans: the spans that hold the prompt's tokens, in the order of the tokens.
        embedding: path of the module whose first argument is the token ids; its longest call in a replan is the prompt.
            Where a tokenizer is given, it is an error if it is not called.
        skip_ids: ids that are no text (placeholders for patches): they have no key in `spans`.
        skip_first: number of ids before the first that has a key (placeholders that the policy replaced by another id).
        skip_last: number of ids behind the last that has a key (an end that the policy embeds and does not compute).
        site: the site whose spans these are; None for every site that has them, at the same keys.
        state_between: texts around the state, where a policy writes its numbers into the prompt, after the instruction.
        generated: the spans of tokens that the policy writes itself before it acts (a subtask), in their order. Their
            ids are those that the embedding is given after the prompt's, in calls of fewer tokens, or behind them. They
            keep the role of their span.
    """

    spans: tuple[str, ...]
    embedding: str
    skip_ids: tuple[int, ...] = ()
    skip_first: int = 0
    skip_last: int = 0
    site: str | None = None
    state_between: tuple[str, str] | None = None
    generated: tuple[str, ...] = ()


class PolicyLayout(Document, frozen=True):
    """What a policy's attention calls are. All of it is plain data (`schemas.jsonable`).

    Attributes:
        name: the policy's name in the store, for instance "smolvla".
        family: its family; stores of one family can be compared layer by layer.
        sites: what is recorded.
        rules: what each call is; a call that no rule names is an error.
        num_layers, num_heads: number of blocks, and of attention heads of a block.
        num_denoise_steps: how often every block of every site computes in one policy call; 1 without a denoising loop.
        denoise_times: the flow time of each denoise step; empty: not known, and stored as the step's number.
        cameras: cameras whose pictures the caller may give.
        text: where the prompt is; None: the caller gives it, or nothing is known of it.
        action_horizon: number of actions of a policy call; 0: not known.
        action_dim: number of dimensions of an action; 0: not known.
        autoregressive: every generated token is one call: the calls of a block, one after another, are the action
            queries of one replan. `num_denoise_steps` is 1 then. Each call has the site's `action_queries`; its
            keys are those that exist so far; those of generated tokens are a span with `growing`, the last one.
        num_action_tokens: number of generated tokens of an autoregressive policy.
        stops_early: it may generate fewer tokens than that; then only the mean over its action queries can be recorded.
        versions: library -> versions that the layout was written for and tried with, for instance {"lerobot":
            ("0.4.4",)}; "5." takes every version that begins with it.
        config: what else distinguishes policies of this family; goes into the store.
    """

    name: str
    family: str
    sites: tuple[RecordedSite, ...]
    rules: tuple[CallRule, ...]
    num_layers: int
    num_heads: int
    num_denoise_steps: int = 1
    denoise_times: tuple[Number, ...] = ()
    cameras: tuple[CameraPicture, ...] = ()
    text: PromptText | None = None
    action_horizon: int = 0
    action_dim: int = 0
    autoregressive: bool = False
    num_action_tokens: int = 0
    stops_early: bool = False
    versions: dict[str, tuple[str, ...]] = field(default_factory=dict)
    config: dict[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Raise `BadArgument` with everything that does not fit together."""
        check_text("policy's name", self.name)
        check_text("policy's family", self.family)
        sites = [site.keys for site in self.sites]
        for camera in dict.fromkeys(camera for site in sites for camera in site.pictured):
            picture_size(sites, camera)  # raises the error that names the sizes, where sites have other ones
        if problems := list(self._problems()):
            raise BadArgument(f"The layout of '{self.name}' is wrong: {'; '.join(problems)}.")

    def _problems(self) -> Iterator[str]:
        names = [site.name for site in self.sites]
        if not names:
            yield "it has no site"
        if len(set(names)) != len(names):
            yield f"two of its sites have the same name ({listing(names)})"
        ruled = {site for rule in self.rules for site in rule.sites}
        for name in sorted(ruled - set(names)):
            yield f"a rule gives calls to the site '{name}', which does not exist (sites: {listing(names)})"
        for name in sorted({rule.tokens for rule in self.rules if rule.tokens} - set(names)):
            yield f"a rule has the tokens of site '{name}', which does not exist (sites: {listing(names)})"
        for name in names:
            if name not in ruled:
                yield f"no rule gives calls to the site '{name}'"
        for what, count in (("layers", self.num_layers), ("heads", self.num_heads), ("steps", self.num_denoise_steps)):
            if count < 1:
                yield f"its number of {what} is {count}"
        if self.denoise_times and len(self.denoise_times) != self.num_denoise_steps:
            yield f"it has {len(self.denoise_times)} denoise times for {self.num_denoise_steps} denoise steps"
        for site in self.sites:
            if not self.autoregressive and not site.num_action_queries:
                yield (
                    f"the number of action queries of site '{site.name}' depends on the call ({site.action_queries}); "
                    "count both ends from the same side, as (0, 50) or (-50, None)"
                )
        for library, versions in self.versions.items():
            if isinstance(versions, str):
                yield f"its versions of {library} are one text; expected several, as ('{versions}',)"
        if self.autoregressive and (self.num_denoise_steps != 1 or self.num_action_tokens < 1):
            yield "an autoregressive policy has one denoise step and at least one action token"
        pictured = {camera for site in self.sites for camera in site.keys.cameras}
        for camera in self.cameras:
            if camera.name not in pictured:
                yield f"the camera '{camera.name}' has no span in any site (cameras there: {listing(sorted(pictured))})"
        if self.text is not None:
            for site in self.text_sites:
                for span in (*self.text.spans, *self.text.generated):
                    if span not in [known.name for known in site.keys.spans]:
                        yield f"the prompt's span '{span}' is not in site '{site.name}'"
            if not self.text_sites:
                yield f"no site has the prompt's spans {listing(self.text.spans)}"
            yield from self._prompts_elsewhere()

    def _prompts_elsewhere(self) -> Iterator[str]:
        # The store keeps one prompt of a replan, whose pieces name keys.
        places: dict[tuple[tuple[int, int], ...], str] = {}
        for site in self.text_sites:
            spans = [span for span in site.keys.spans if self.text is not None and span.name in self.text.spans]
            places.setdefault(tuple((span.start, span.stop) for span in spans), site.name)
        if len(places) > 1:
            yield (
                f"the prompt has other keys at the sites {listing(places.values())}; say with PromptText(site=...) "
                "at which of them its words are known"
            )

    @property
    def text_sites(self) -> tuple[RecordedSite, ...]:
        """The sites that hold the prompt's tokens."""
        if self.text is None:
            return ()
        if self.text.site is not None:
            return (self.site(self.text.site),)
        first = self.text.spans[0] if self.text.spans else ""
        return tuple(site for site in self.sites if first in [span.name for span in site.keys.spans])

    @property
    def camera_names(self) -> tuple[str, ...]:
        """Names of all cameras, in the order of the keys."""
        return tuple(dict.fromkeys(camera for site in self.sites for camera in site.keys.cameras))

    def site(self, name: str) -> RecordedSite:
        """Return the site of that name; the error lists the existing ones."""
        for site in self.sites:
            if site.name == name:
                return site
        raise unknown_name("site", name, [site.name for site in self.sites])


def check_is_layout(layout: object) -> None:
    """Raise `BadArgument` for what is no layout."""
    if not isinstance(layout, PolicyLayout):
        raise BadArgument(
            f"The layout is of type {type(layout).__name__}; expected a va.PolicyLayout (docs/my-policy.md). "
            "va.inspect(policy, call) shows the calls that it has to name."
        )


def check_versions(layout: PolicyLayout, installed: dict[str, str | None]) -> str | None:
    """Say in a sentence which installed libraries the layout was not written for; None when all fit.

    installed: library -> its version, None where it is not installed.
    """
    others = []
    for library, versions in layout.versions.items():
        given = installed.get(library)
        fits = given is not None and any(
            given.startswith(version) if version.endswith(".") else given == version for version in versions
        )
        if not fits:
            others.append(f"{library} {listing(versions)} (installed: {given or 'none'})")
    if not others:
        return None
    return (
        f"The layout '{layout.name}' was written for {' and '.join(others)}; another version may compute in other "
        "modules or order. Compare va.inspect(...) with the layout, and record with any_version=True if it fits."
    )
