"""Short names of interventions: the default name of a condition, which becomes part of a file's name."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Sequence

from vla_attention.schemas.errors import runs_of
from vla_attention.schemas.interventions import (
    AttentionScale,
    AttentionUniform,
    ImageChange,
    Interventions,
    KeyKnockout,
    PromptChange,
    queries_suffix,
)

#: Longest name; what is longer is cut, and the store says the whole.
_LONGEST = 80
#: Characters of the digest that keeps names apart that were cut.
_DIGEST = 8
#: Operators of selectors, which a file's name cannot have.
_OPERATORS = ((" - ", "_but_"), ("&", "_and_"), ("|", "_or_"))


def condition_name(interventions: Interventions) -> str:
    """Return a name such as `without_camera_base_0_rgb`, of letters, digits, `_`, `.` and `+`; empty for no change.

    Everything that differs from the default is in it (queries, layers, heads, denoise steps, weight, seeds), so that
    two conditions have two names.
    """
    parts = [_of_knockout(change) for change in interventions.keys]
    parts += [_of_attention(change) for change in interventions.attention]
    parts += [_of_prompt(interventions.prompt)] if interventions.prompt else []
    parts += [_of_image(change) for change in interventions.images]
    parts += [f"noise_{interventions.noise.seed}"] if interventions.noise else []
    name = "+".join(plain(part) for part in parts)
    if len(name) <= _LONGEST:
        return name
    digest = hashlib.sha256("+".join(parts).encode("utf-8", "replace")).hexdigest()[:_DIGEST]
    return f"{name[: _LONGEST - _DIGEST - 1]}_{digest}"


def knockout_of_group(kind: str, group: str, knockout: KeyKnockout) -> Interventions:
    """Return a condition such as `without_word_red_queries_all`: its name says for whom the keys are cut."""
    of_queries = plain(queries_suffix(knockout.queries, knockout.query_selector))
    return Interventions("_".join(part for part in (kind, group, of_queries) if part), keys=(knockout,))


def plain(text: str) -> str:
    """Return a selector, or a part of a name, as letters, digits, `_` and `.`."""
    for operator, word in _OPERATORS:
        text = text.replace(operator, word)
    return re.sub(r"_+", "_", re.sub(r"[^\w.]+", "_", text)).strip("_")


def _of_knockout(change: KeyKnockout) -> str:
    kind = "random" if change.random_seed is not None else "only" if change.keep else "without"
    if change.random_seed is not None and change.keep:
        kind = "random_only"
    name = f"{kind}_{change.selector}{queries_suffix(change.queries, change.query_selector)}"
    name += _of_places(change.layers, change.heads, change.denoise_steps)
    name += "" if change.weight == 1 else f"_weight_{change.weight:g}"
    return name + _of_seed(change.random_seed or 0)


def _of_attention(change: AttentionScale | AttentionUniform) -> str:
    places = queries_suffix(change.queries) + _of_places(change.layers, change.heads, change.denoise_steps)
    if isinstance(change, AttentionUniform):
        return f"uniform_{change.selector}{places}"
    return f"{change.selector}_times_{change.factor:g}{places}"


def _of_prompt(change: PromptChange) -> str:
    detail = {
        "task": f"_{change.task_id}",
        "text": f"_{change.text}",
        "shuffled": _of_seed(change.seed),
        "synonyms": "".join(f"_{word}_{synonym}" for word, synonym in change.synonyms.items()),
    }.get(change.kind, "")
    return f"prompt_{change.meaning or change.kind}{detail}"


def _of_image(change: ImageChange) -> str:
    detail = f"_{change.object}" if change.object else ""
    if change.kind == "shifted":
        detail += f"_{_signed(change.rows, 'down', 'up')}_{_signed(change.columns, 'right', 'left')}"
    return f"{change.camera}_{change.kind}{detail}{_of_seed(change.seed)}"


def _signed(number: int, positive: str, negative: str) -> str:
    return f"{negative if number < 0 else positive}_{abs(number)}"


def _of_seed(seed: int) -> str:
    return f"_seed_{seed}" if seed else ""


def _of_places(*places: tuple[int, ...] | None) -> str:
    named = zip(("layers", "heads", "steps"), places, strict=True)
    return "".join(f"_{name}_{_in_runs(chosen)}" for name, chosen in named if chosen is not None)


def _in_runs(chosen: Sequence[int]) -> str:
    """Return numbers in ascending order as text; three and more that follow each other are `first_to_last`."""
    return "_".join(f"{run[0]}_to_{run[-1]}" if len(run) > 2 else "_".join(map(str, run)) for run in runs_of(chosen))
