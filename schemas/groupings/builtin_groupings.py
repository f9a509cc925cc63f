"""The built-in groupings. Each is a function of the names in the stores, because cameras and objects differ.

To add one, write its function and its entry in `BUILTIN_GROUPINGS`.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

from vla_attention.schemas.errors import did_you_mean, listing
from vla_attention.schemas.groupings.grouping import (
    Grouping,
    GroupingError,
    GroupingNotFound,
    Ratio,
    read_grouping_file,
)
from vla_attention.schemas.groupings.vocabulary import NO_COVERAGE, NO_WORDS, Vocabulary

#: Keys that the published pi scripts call text: their prompt is padded to this length by default.
PUBLISHED_TEXT_KEYS = 256
_REFERENCE = re.compile(r"reference:(\d+)")
#: Every valid text key that is not a state digit.
TEXT_KEYS = "role:bos | role:template | role:instruction | role:text"


def _others(vocabulary: Vocabulary) -> dict[str, tuple[str, ...]]:
    """Groups of all other keys, so that the masses of a grouping sum to the row sum."""
    # Cosmos's padded text takes attention and adds nothing.
    null = {"null": ("role:null",)} if "null" in vocabulary.roles else {}
    # Patches of a letterbox, beside a picture of another shape: they take attention and show nothing.
    border = {"border": ("role:border",)} if "border" in vocabulary.roles else {}
    return {
        "state": ("role:state | role:proprio",),
        "action": ("role:action",),
        **null,
        **border,
        "padding": ("role:padding",),
        "masked": ("role:masked_image",),
        "other": ("*",),
    }


_TEXT_ROLES = {"bos", "template", "instruction", "text"}


def _over_linguistic(vocabulary: Vocabulary, *numerator: str) -> Ratio | None:
    """The ratio to the linguistic group, at sites that have both kinds of keys (Cosmos: not at `self`)."""
    both = "image" in vocabulary.roles and _TEXT_ROLES & set(vocabulary.roles)
    return Ratio(numerator, ("linguistic",)) if numerator and both else None


def default(vocabulary: Vocabulary) -> Grouping:
    """Visual: every valid image key; linguistic: every valid text key that is not a state digit."""
    others = _others(vocabulary)
    return Grouping(
        name="default",
        groups={"visual": ("role:image",), "linguistic": (TEXT_KEYS,), **others},
        ratio=_over_linguistic(vocabulary, "visual"),
        allow_empty=("visual", "linguistic", *others),
        description="visual = every valid image key; linguistic = every valid text key that is not a state digit",
    )


def instruction(vocabulary: Vocabulary) -> Grouping:
    """Linguistic is the words of the instruction only; bos and template text are a group of their own."""
    if "text" in vocabulary.roles and "instruction" not in vocabulary.roles:
        raise GroupingError(f"Grouping 'instruction': {NO_WORDS}.")
    others = _others(vocabulary)
    return Grouping(
        name="instruction",
        groups={
            "visual": ("role:image",),
            "linguistic": ("role:instruction",),
            "template": ("role:bos | role:template | role:text",),
            **others,
        },
        ratio=_over_linguistic(vocabulary, "visual"),
        allow_empty=("visual", "linguistic", "template", *others),
        description="visual = every valid image key; linguistic = the words of the instruction only",
    )


def cameras(vocabulary: Vocabulary) -> Grouping:
    """One group per camera that is not masked."""
    others = _others(vocabulary)
    views = {camera: (f"camera:{camera} & role:image",) for camera in vocabulary.cameras}
    return Grouping(
        name="cameras",
        groups={**views, "linguistic": (TEXT_KEYS,), **others},
        ratio=_over_linguistic(vocabulary, *views),
        allow_empty=(*views, "linguistic", *others),
        description="one group per camera; linguistic as in 'default'",
    )


def objects(vocabulary: Vocabulary) -> Grouping:
    """One group per object of the scene, by the area of each patch that it covers."""
    others = _others(vocabulary)
    if not vocabulary.objects:
        raise GroupingError(f"Grouping 'objects': {NO_COVERAGE}.")
    things = {name: (f"object:{name}",) for name in vocabulary.objects}
    return Grouping(
        name="objects",
        groups={**things, "linguistic": (TEXT_KEYS,), **others},
        ratio=_over_linguistic(vocabulary, *things),
        allow_empty=(*things, "linguistic", *others),
        description="one group per scene object, weighted by the area of each patch that it covers; "
        "linguistic as in 'default'",
    )


def reference(vocabulary: Vocabulary, text_keys: int | None = None) -> Grouping:
    """The published scripts' key ranges on our rows, to compare with old numbers.

    The groups are not what their names say. pi: "visual" is the first camera, "linguistic" the next `text_keys` keys
    (those of the next camera, at 256 its patches exactly), "action" all the rest. A range that reaches beyond the last
    key ends there, as the scripts' slices do. Cosmos: frame `curr_last` over frame `frame0`, a blank picture. The
    scripts' queries differ too: docs/reading.md.

    Args:
        vocabulary: the names in the stores.
        text_keys: length of the scripts' prompt (their `--max-token-len`), for pi; None is their default, 256.
    """
    name = "reference" if text_keys is None else f"reference-{text_keys}"
    spans = vocabulary.layout.spans
    if any(span.kind == "latent" for span in spans):
        if text_keys is not None:
            raise GroupingError(
                f"Cannot use the grouping 'reference:{text_keys}' here: a number of text keys belongs to the published "
                "pi scripts, and the Cosmos scripts compare latent frames; expected 'reference'."
            )
        groups = {"visual": ("frame:curr_last",), "linguistic": ("frame:frame0",)}
        return Grouping(
            name=name,
            groups=groups,
            ratio=Ratio(("visual",), ("linguistic",)),
            description="the published Cosmos scripts' frames: 'linguistic' is a blank picture, and holds no language",
            proxy=True,
            published_denoise="last",
        )
    images = [span for span in spans if span.kind == "image"]
    if not images or not any(span.kind == "text" for span in spans):
        raise GroupingError(
            "The grouping 'reference' is defined for the sites 'joint' (pi) and 'self' (Cosmos) only; "
            "choose with --site."
        )
    # As many keys as the first camera has, in all of its spans.
    own = [
        span for span in images if span is images[0] or (span.camera is not None and span.camera == images[0].camera)
    ]
    first, wanted = sum(span.num_keys for span in own), PUBLISHED_TEXT_KEYS if text_keys is None else text_keys
    last = min(first + wanted, vocabulary.layout.num_keys) - 1
    if last < first:
        raise GroupingError(f"Cannot use the grouping 'reference:{wanted}': expected at least one text key.")
    cut = f" (of {wanted} keys; the site ends there)" if last - first + 1 < wanted else ""
    return Grouping(
        name=name,
        groups={"visual": (f"keys:0-{first - 1}",), "linguistic": (f"keys:{first}-{last}",), "action": ("*",)},
        ratio=Ratio(("visual",), ("linguistic",)),
        allow_empty=("action",),
        description=f"the published pi scripts' key ranges: 'linguistic' is keys {first} to {last}{cut}, "
        "wherever the prompt really is",
        proxy=True,
        published_denoise="first",
    )


BUILTIN_GROUPINGS: dict[str, Callable[[Vocabulary], Grouping]] = {
    "default": default,
    "instruction": instruction,
    "cameras": cameras,
    "objects": objects,
    "reference": reference,
}


def find_grouping(name_or_file: str, vocabulary: Vocabulary) -> Grouping:
    """Find a built-in grouping by name (`reference:N`: `reference` with N text keys), or read a TOML file."""
    with_keys = _REFERENCE.fullmatch(name_or_file)
    if with_keys is not None:
        return reference(vocabulary, int(with_keys[1]))
    if name_or_file in BUILTIN_GROUPINGS:
        return BUILTIN_GROUPINGS[name_or_file](vocabulary)
    path = Path(name_or_file)
    if path.suffix == ".toml" or path.exists():
        return read_grouping_file(path)
    if name_or_file.startswith("reference:"):
        raise GroupingNotFound(
            f"Unknown grouping '{name_or_file}'; expected 'reference:N' with a whole number N of text keys, or "
            "'reference'."
        )
    raise GroupingNotFound(
        f"Unknown grouping '{name_or_file}'.{did_you_mean(name_or_file, BUILTIN_GROUPINGS)} "
        f"Built in: {listing(BUILTIN_GROUPINGS)} (also reference:N); "
        "anything else is taken as a TOML file, and there is none of that name."
    )
