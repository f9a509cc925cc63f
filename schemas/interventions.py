"""Interventions: what a run changes in the policy's attention, prompt, pictures or noise.

They are settings, stored in the root attributes of a store and part of the run's configuration. `docs/effects.md`
has the formulas; the arithmetic is in `capture/interventions/`. Groups of keys are named in the grouping language.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import Literal

from msgspec import field

from vla_attention.schemas.errors import BadArgument, listing
from vla_attention.schemas.jsonable import Document
from vla_attention.schemas.safe_text import check_name, check_text, visible

Queries = Literal["action", "all", "prefix"]
#: What another sentence is to the task's own. `exchanged`: a word of it for one that other tasks of its family have.
PromptKind = Literal["written otherwise", "paraphrased", "exchanged", "contradicted", "other task", "empty", "shuffled"]
_READERS: dict[Queries, str] = {
    "action": "the action queries",
    "all": "all queries",
    "prefix": "the prefix's queries",
}


def readers(queries: Queries, query_selector: str = "") -> str:
    """Whose attention changes, in words."""
    return _READERS[queries] + (f" of '{query_selector}'" if query_selector else "")


def queries_suffix(queries: Queries, query_selector: str = "") -> str:
    """The end of a condition's name that says for whom keys are cut; empty for the action queries."""
    if queries == "action":
        return ""
    return f"_queries_{queries}" + (f"_of_{query_selector}" if query_selector else "")


class KeyKnockout(Document, frozen=True):
    """Keys whose attention is taken away: log(1 - w) is added to the logits of a key of weight w.

    A weight of 1 gives a probability of exactly 0, and the other keys share what is left.

    Attributes:
        selector: the keys, in the grouping language; each key has its weight in the group, 0 to 1.
        keep: knock out the rest instead, with 1 minus the weight in the group. The rest is of the valid keys (no
            padding, no masked camera) of every site where the group has keys, without the action keys.
        queries: whose attention changes. `action`: the action queries. `all`: every query that could carry the
            information on, which still read their own key: in pi also those of the prefix and of the state, in Cosmos
            all tokens. `prefix`: the queries of pi's prefix only.
        query_selector: with `prefix`, the tokens of the prefix whose queries change, in the grouping language; empty
            for all of them.
        weight: factor of the weights, 0 to 1.
        layers, heads, denoise_steps: where attention changes; None is everywhere.
        random_seed: instead of the group, knock out equally many (its sum of weights, rounded) keys outside of it,
            drawn for every replan from the valid keys that are no action keys. The control of the group. Padding does
            not count.
    """

    selector: str
    keep: bool = False
    queries: Queries = "action"
    query_selector: str = ""
    weight: float = 1.0
    layers: tuple[int, ...] | None = None
    heads: tuple[int, ...] | None = None
    denoise_steps: tuple[int, ...] | None = None
    random_seed: int | None = None

    def __post_init__(self) -> None:
        """Check the selectors' text and the numbers."""
        _check_selector(self.selector)
        if self.query_selector:
            _check_selector(self.query_selector)
            if self.queries != "prefix":
                raise BadArgument(
                    f"The query selector '{self.query_selector}' goes with the queries 'prefix', not '{self.queries}'."
                )
        if not 0 <= self.weight <= 1:
            raise BadArgument(f"A knockout of '{self.selector}' has the weight {self.weight}; expected 0 to 1.")
        _check_places(self.selector, self.layers, self.heads, self.denoise_steps)
        _check_seed("a random control", self.random_seed)

    def describe(self) -> str:
        """The intervention in words."""
        what = "all keys but" if self.keep else "the keys of"
        if self.random_seed is not None:
            what = f"random keys (seed {self.random_seed}), as many as {what}"
        strength = "" if self.weight == 1 else f" with the weight {self.weight:g}"
        places = _describe_places(self.layers, self.heads, self.denoise_steps)
        return (
            f"{what} '{self.selector}' knocked out{strength} for {readers(self.queries, self.query_selector)}{places}"
        )


class AttentionScale(Document, frozen=True, tag_field="kind", tag="scale"):
    """A group's weights before normalising are multiplied by a factor; 0 is a knockout.

    A key of weight w in the group is multiplied by 1 - w + w · factor. Other fields as in `KeyKnockout`.
    """

    selector: str
    factor: float
    queries: Queries = "action"
    layers: tuple[int, ...] | None = None
    heads: tuple[int, ...] | None = None
    denoise_steps: tuple[int, ...] | None = None

    def __post_init__(self) -> None:
        """Check the selector's text and the numbers."""
        _check_selector(self.selector)
        if not (math.isfinite(self.factor) and self.factor >= 0):
            raise BadArgument(f"The attention of '{self.selector}' has the factor {self.factor}; expected 0 or more.")
        _check_places(self.selector, self.layers, self.heads, self.denoise_steps)

    def describe(self) -> str:
        """The intervention in words."""
        places = _describe_places(self.layers, self.heads, self.denoise_steps)
        return f"attention to '{self.selector}' times {self.factor:g}{_describe_readers(self.queries)}{places}"


class AttentionUniform(Document, frozen=True, tag_field="kind", tag="uniform"):
    """Inside of a group, the weights before normalising are replaced by their mean; the group keeps its sum.

    With fractional weights w, the part w of each key is taken out and the sum of the parts is dealt out in proportion
    to w. Other fields as in `KeyKnockout`.
    """

    selector: str
    queries: Queries = "action"
    layers: tuple[int, ...] | None = None
    heads: tuple[int, ...] | None = None
    denoise_steps: tuple[int, ...] | None = None

    def __post_init__(self) -> None:
        """Check the selector's text and the numbers."""
        _check_selector(self.selector)
        _check_places(self.selector, self.layers, self.heads, self.denoise_steps)

    def describe(self) -> str:
        """The intervention in words."""
        places = _describe_places(self.layers, self.heads, self.denoise_steps)
        return f"attention made uniform inside '{self.selector}'{_describe_readers(self.queries)}{places}"


class PromptChange(Document, frozen=True):
    """Another instruction than the task's.

    `empty`: none. `shuffled`: its words in another order, drawn from `seed`. `task`: that of the suite's task
    `task_id`. `text`: `text`. `synonyms`: words replaced by those that `synonyms` gives for them. `meaning`: what the
    sentence is to the task's own, where somebody said it.
    """

    kind: Literal["empty", "shuffled", "task", "text", "synonyms"]
    text: str = ""
    task_id: int | None = None
    synonyms: dict[str, str] = field(default_factory=dict)
    seed: int = 0
    meaning: PromptKind | Literal[""] = ""

    def __post_init__(self) -> None:
        """Check that the kind has what it needs."""
        _check_seed("shuffled words", self.seed)
        if (self.kind == "task") != (self.task_id is not None):
            raise BadArgument(f"A prompt change '{self.kind}' has the task {self.task_id}; only 'task' needs one.")
        if (self.kind == "synonyms") != bool(self.synonyms):
            raise BadArgument(f"A prompt change '{self.kind}' has {len(self.synonyms)} synonyms; only 'synonyms' does.")

    def describe(self) -> str:
        """The intervention in words."""
        pairs = [f"'{visible(word)}' replaced by '{visible(synonym)}'" for word, synonym in self.synonyms.items()]
        return {
            "empty": "the instruction empty",
            "shuffled": f"the instruction's words shuffled (seed {self.seed})",
            "task": f"the instruction of task {self.task_id}",
            "text": f"the instruction '{visible(self.text)}'",
            "synonyms": listing(pairs, 6),
        }[self.kind]


class ImageChange(Document, frozen=True):
    """Another picture of one camera of the policy, in the model's picture.

    `blank`: grey. `noise`: uniform noise, drawn from `seed`. `rotated`: by half a turn. `shifted`: by `rows` patches
    down and `columns` patches to the right. `masked`: the patches that show some of `object` get the mean colour
    of the others. `filled`: they are filled from their surroundings. `mean`: the mean of the task's pictures in a
    store; effects alone use it.
    """

    camera: str
    kind: Literal["blank", "noise", "rotated", "shifted", "masked", "filled", "mean"]
    object: str = ""
    rows: int = 0
    columns: int = 0
    seed: int = 0

    def __post_init__(self) -> None:
        """Check the names, and that the kind has what it needs."""
        check_name("camera", self.camera)
        _check_seed("a picture of noise", self.seed)
        if (self.kind in ("masked", "filled")) != bool(self.object):
            raise BadArgument(
                f"A picture change '{self.kind}' names the object '{self.object}'; 'masked' and 'filled' name one, the "
                "others none."
            )
        if self.object:
            check_name("object", self.object)

    def describe(self) -> str:
        """The intervention in words."""
        detail = f" '{self.object}'" if self.object else ""
        detail += f" by {self.rows}, {self.columns} patches" if self.kind == "shifted" else ""
        detail += f" (seed {self.seed})" if self.kind == "noise" and self.seed else ""
        how = "replaced by the mean of the task's pictures" if self.kind == "mean" else self.kind
        return f"camera '{self.camera}' {how}{detail}"


class NoiseChange(Document, frozen=True):
    """Another initial noise on the same inputs: `seed` is used in place of the run's."""

    seed: int

    def __post_init__(self) -> None:
        """Check the seed."""
        _check_seed("the noise", self.seed)

    def describe(self) -> str:
        """The intervention in words."""
        return f"the noise of seed {self.seed}"


class Interventions(Document, frozen=True):
    """Everything that a run changes; without arguments, nothing.

    name: a short name of the condition, for instance `without_visual`. `keys` come first, then `attention`, each in
    the order given.
    """

    name: str = ""
    keys: tuple[KeyKnockout, ...] = ()
    attention: tuple[AttentionScale | AttentionUniform, ...] = ()
    prompt: PromptChange | None = None
    images: tuple[ImageChange, ...] = ()
    noise: NoiseChange | None = None

    def __post_init__(self) -> None:
        """Check the name."""
        check_text("intervention's name", self.name)

    @property
    def is_none(self) -> bool:
        """Whether nothing is changed."""
        return not (self.changes_attention or self.changes_input or self.noise)

    @property
    def changes_attention(self) -> bool:
        """Whether the attention of some keys is changed."""
        return bool(self.keys or self.attention)

    @property
    def changes_input(self) -> bool:
        """Whether the prompt or a picture is changed."""
        return self.prompt is not None or bool(self.images)

    def describe(self) -> str:
        """All interventions in words, on one line."""
        parts = [change.describe() for change in (*self.keys, *self.attention)]
        parts += [self.prompt.describe()] if self.prompt else []
        parts += [change.describe() for change in self.images]
        parts += [self.noise.describe()] if self.noise else []
        return "; ".join(parts) if parts else "none"


def knockout(
    *selectors: str,
    keep: bool = False,
    layers: Iterable[int] | None = None,
    heads: Iterable[int] | None = None,
    denoise_steps: Iterable[int] | None = None,
    weight: float = 1.0,
    name: str = "",
) -> Interventions:
    """Groups of keys that the action queries do not read, or with `keep` the one that alone they read.

    >>> knockout("word:bowl", layers=[1]).describe()
    "the keys of 'word:bowl' knocked out for the action queries, layers 1"

    selectors: in the grouping language. layers, heads, denoise_steps: where; None is everywhere. weight: the share of
    the weights that is taken away, 0 to 1. name: of the condition, for tables.

    Raises:
        BadArgument: a number is below 0, or the weight is none.
    """
    layers, heads, denoise_steps = (
        None if chosen is None else tuple(sorted(set(chosen))) for chosen in (layers, heads, denoise_steps)
    )
    return Interventions(
        name,
        tuple(
            KeyKnockout(selector, keep=keep, weight=weight, layers=layers, heads=heads, denoise_steps=denoise_steps)
            for selector in selectors
        ),
    )


class RerunSource(Document, frozen=True):
    """The store whose policy calls a rerun repeats.

    `run` is the digest of its run's configuration (`run_digest`) and `name` the name of its folder. Episodes and
    replans of the rerun are those of the same name and index there.
    """

    run: str
    name: str

    def __post_init__(self) -> None:
        """Check that both are text of one line."""
        check_text("base run's digest", self.run)
        check_text("base run's name", self.name)


def _check_selector(selector: str) -> None:
    if not selector.strip():
        raise BadArgument("An intervention has no selector; expected for instance 'camera:NAME' or 'word:NAME'.")
    check_text("intervention's selector", selector)


def _check_places(selector: str, *places: Sequence[int] | None) -> None:
    for name, chosen in zip(("layers", "heads", "denoise steps"), places, strict=True):
        if chosen is None:
            continue
        if not chosen or min(chosen) < 0 or list(chosen) != sorted(set(chosen)):
            raise BadArgument(
                f"The intervention on '{selector}' has the {name} {listing(chosen)}; expected different numbers from 0 "
                "up, in ascending order."
            )


def _check_seed(what: str, seed: int | None) -> None:
    if seed is not None and seed < 0:
        raise BadArgument(f"The seed of {what} is {seed}; expected 0 or more.")


def _describe_readers(queries: Queries) -> str:
    """Whose attention changes; the action queries go without saying."""
    return "" if queries == "action" else f" for {_READERS[queries]}"


def _describe_places(*places: tuple[int, ...] | None) -> str:
    named = zip(("layers", "heads", "denoise steps"), places, strict=True)
    return "".join(f", {name} {listing(chosen)}" for name, chosen in named if chosen is not None)
