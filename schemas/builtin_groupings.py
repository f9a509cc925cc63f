"""The groupings that come with the tool. Each is a function of what the stores hold, because cameras and objects differ."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from schemas.errors import did_you_mean, listing
from schemas.grouping import Grouping, GroupingNotFound, Ratio, read_grouping_file
from schemas.vocabulary import Vocabulary

_TEXT = "role:bos | role:template | role:instruction | role:text"
#: Groups that stand beside the visual and the linguistic ones so that the masses of a grouping sum to the row sum.
_OTHERS = {
    "state": ("role:state | role:proprio",),
    "action": ("role:action",),
    "padding": ("role:padding | role:null",),
    "masked": ("role:masked_image",),
    "other": ("*",),
}


_TEXT_ROLES = {"bos", "template", "instruction", "text"}


def _over_linguistic(vocabulary: Vocabulary, *numerator: str) -> Ratio | None:
    """The ratio to the linguistic group, where a site has both kinds of keys: Cosmos's self-attention has no text."""
    both = "image" in vocabulary.roles and _TEXT_ROLES & set(vocabulary.roles)
    return Ratio(numerator, ("linguistic",)) if numerator and both else None


def default(vocabulary: Vocabulary) -> Grouping:
    """Visual: every valid image key; linguistic: every valid text key that is not a state digit."""
    return Grouping(
        name="default",
        groups={"visual": ("role:image",), "linguistic": (_TEXT,), **_OTHERS},
        ratio=_over_linguistic(vocabulary, "visual"),
        allow_empty=("visual", "linguistic", *_OTHERS),
        description="visual = every valid image key; linguistic = every valid text key that is not a state digit",
    )


def instruction(vocabulary: Vocabulary) -> Grouping:
    """Linguistic is the words of the instruction only; bos and template text are a group of their own."""
    return Grouping(
        name="instruction",
        groups={
            "visual": ("role:image",),
            "linguistic": ("role:instruction",),
            "template": ("role:bos | role:template | role:text",),
            **_OTHERS,
        },
        ratio=_over_linguistic(vocabulary, "visual"),
        allow_empty=("visual", "linguistic", "template", *_OTHERS),
        description="visual = every valid image key; linguistic = the words of the instruction only",
    )


def cameras(vocabulary: Vocabulary) -> Grouping:
    """One group per camera that the policy really sees."""
    views = {camera: (f"camera:{camera} & role:image",) for camera in vocabulary.cameras}
    return Grouping(
        name="cameras",
        groups={**views, "linguistic": (_TEXT,), **_OTHERS},
        ratio=_over_linguistic(vocabulary, *views),
        allow_empty=(*views, "linguistic", *_OTHERS),
        description="one group per camera; linguistic as in 'default'",
    )


def objects(vocabulary: Vocabulary) -> Grouping:
    """One group per object of the scene, by the area of each patch that it covers."""
    things = {name: (f"object:{name}",) for name in vocabulary.objects}
    return Grouping(
        name="objects",
        groups={**things, "linguistic": (_TEXT,), **_OTHERS},
        ratio=_over_linguistic(vocabulary, *things),
        allow_empty=(*things, "linguistic", *_OTHERS),
        description="one group per scene object, weighted by the area of each patch that it covers; linguistic as in 'default'",
    )


BUILTIN_GROUPINGS: dict[str, Callable[[Vocabulary], Grouping]] = {
    "default": default,
    "instruction": instruction,
    "cameras": cameras,
    "objects": objects,
}


def find_grouping(name_or_file: str, vocabulary: Vocabulary) -> Grouping:
    """Find a built-in grouping by name, or read a TOML file."""
    if name_or_file in BUILTIN_GROUPINGS:
        return BUILTIN_GROUPINGS[name_or_file](vocabulary)
    path = Path(name_or_file)
    if path.suffix == ".toml" or path.exists():
        return read_grouping_file(path)
    raise GroupingNotFound(
        f"Unknown grouping '{name_or_file}'.{did_you_mean(name_or_file, BUILTIN_GROUPINGS)} "
        f"Built in: {listing(BUILTIN_GROUPINGS)}; anything else is taken as a TOML file, and there is none of that name."
    )
