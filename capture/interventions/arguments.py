"""Interventions as they are typed, and what that means. Imports nothing heavy: every `--help` needs it."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from vla_attention.schemas.errors import BadArgument, did_you_mean, listing
from vla_attention.schemas.interventions import (
    AttentionScale,
    AttentionUniform,
    ImageChange,
    Interventions,
    KeyKnockout,
    NoiseChange,
    PromptChange,
)
from vla_attention.schemas.options import option, read_options

#: Who does not read what is knocked out, unless the command line says it.
DEFAULT_QUERIES = "all"
_QUERIES = ("action", "all", "prefix", "prefix:SELECTOR")
_PROMPTS = ("empty", "shuffled", "shuffled:SEED", "task:N", "text:TEXT", "synonyms:FILE")
_IMAGES = ("blank", "noise", "noise:SEED", "rotated", "shifted:ROWS,COLUMNS", "masked:OBJECT", "filled:OBJECT")


_WHERE = "in which attention changes, also for --attention (default: all)"


@dataclass(frozen=True)
class InterventionSettings:
    """What is changed in the policy, as typed; `interventions_of` reads it."""

    knockout: tuple[str, ...] = option(
        "tokens that are not read: camera:NAME, word:NAME, object:NAME, role:NAME ..., joined by &, | and - as in "
        "groupings; may be given several times",
        (),
        group="interventions: what is changed in the policy, stored with the run (docs/effects.md)",
        action="append",
        metavar="SELECTOR",
    )
    keep: str | None = option("knock out all other valid tokens, but no action tokens", None, metavar="SELECTOR")
    knockout_queries: str | None = option(
        "who does not read them: all (every query that could carry the information on, the default), action (the "
        "action queries alone: what other tokens have read of them stays), prefix (pi: pictures and prompt only) or "
        "prefix:SELECTOR (those tokens of it)",
        None,
        metavar="QUERIES",
    )
    knockout_layers: tuple[int, ...] | None = option(f"layers {_WHERE}", None)
    knockout_heads: tuple[int, ...] | None = option(f"attention heads {_WHERE}", None)
    knockout_steps: tuple[int, ...] | None = option(f"denoise steps {_WHERE}", None)
    knockout_weight: float | None = option(
        "share of the attention that is taken away, 0 to 1 (default: 1, exactly all of it)", None, metavar="W"
    )
    random_keys: int | None = option(
        "the control: knock out equally many random tokens outside of each group, drawn for every policy call",
        None,
        metavar="SEED",
    )
    attention: tuple[str, ...] = option(
        "multiply a group's attention before normalising (SELECTOR=0.5), or spread it evenly inside the group "
        "(SELECTOR=uniform); may be given several times",
        (),
        action="append",
        metavar="SELECTOR=CHANGE",
    )
    prompt: str | None = option(f"another instruction: {listing(_PROMPTS)}", None, metavar="CHANGE")
    image: tuple[str, ...] = option(
        f"another picture of a camera: {listing(_IMAGES)}; may be given several times",
        (),
        action="append",
        metavar="CAMERA=CHANGE",
    )
    noise_seed: int | None = option("draw the policy's noise from this seed", None)
    allow_empty: bool = option(
        "leave policy calls unchanged in which a group has no token, instead of stopping there", False
    )


def read_interventions(given: argparse.Namespace) -> Interventions:
    """Return the interventions of parsed arguments."""
    return interventions_of(read_options(InterventionSettings, given))


def interventions_of(given: InterventionSettings) -> Interventions:
    """Return what settings say, with layer numbers as given.

    Raises:
        BadArgument: an option cannot be read, or has nothing to act on.
    """
    queries, query_selector = _queries(given.knockout_queries or DEFAULT_QUERIES)
    places = {
        "layers": _numbers(given.knockout_layers),
        "heads": _numbers(given.knockout_heads),
        "denoise_steps": _numbers(given.knockout_steps),
    }
    knocked = [(selector, False) for selector in given.knockout]
    knocked += [(given.keep, True)] if given.keep is not None else []
    keys = tuple(
        KeyKnockout(
            selector,
            keep=keep,
            queries=queries,
            query_selector=query_selector,
            weight=1.0 if given.knockout_weight is None else given.knockout_weight,
            random_seed=given.random_keys,
            **places,
        )
        for selector, keep in knocked
    )
    if query_selector and given.attention:
        raise BadArgument("Cannot use --knockout-queries prefix:SELECTOR with --attention; use action, all or prefix.")
    attention = tuple(_attention(text, {"queries": queries, **places}) for text in given.attention)
    _refuse_idle(given, bool(keys), bool(keys or attention))
    return Interventions(
        keys=keys,
        attention=attention,
        prompt=None if given.prompt is None else _prompt(given.prompt),
        images=tuple(_image(text) for text in given.image),
        noise=None if given.noise_seed is None else NoiseChange(given.noise_seed),
    )


def _refuse_idle(given: InterventionSettings, knocks_out: bool, changes_attention: bool) -> None:
    """Raise `BadArgument` for an option that nothing uses."""
    keys, attention = (knocks_out, "--knockout or --keep"), (changes_attention, "--knockout or --attention")
    pictures = (changes_attention or bool(given.image), "--knockout or --image")
    needs = {"random_keys": keys, "knockout_weight": keys, "allow_empty": pictures}
    needs |= dict.fromkeys(("knockout_queries", "knockout_layers", "knockout_heads", "knockout_steps"), attention)
    for name, (used, what) in needs.items():
        value = getattr(given, name)
        if not used and value is not None and value is not False:  # 0 was given, too
            raise BadArgument(f"--{name.replace('_', '-')} has nothing to act on; give {what} too.")


def _numbers(given: Sequence[int] | None) -> tuple[int, ...] | None:
    return None if given is None else tuple(sorted(set(given)))


def _queries(text: str) -> tuple[Any, str]:
    """Return the queries, and the selector of those of the prefix."""
    name, separator, selector = text.partition(":")
    if name not in ("action", "all", "prefix") or (separator and (name != "prefix" or not selector.strip())):
        raise BadArgument(f"Cannot use --knockout-queries '{text}'; expected one of {listing(_QUERIES)}.")
    return name, selector.strip()


def _attention(text: str, fields: dict[str, Any]) -> AttentionScale | AttentionUniform:
    selector, separator, change = (part.strip() for part in text.rpartition("="))
    if separator and selector and change == "uniform":
        return AttentionUniform(selector, **fields)
    try:
        factor = float(change)
    except ValueError:
        factor = None
    if not separator or not selector or factor is None:
        raise BadArgument(
            f"Cannot read --attention '{text}'; expected SELECTOR=FACTOR or SELECTOR=uniform, for instance "
            "word:bowl=0.5."
        )
    return AttentionScale(selector, factor, **fields)


def _prompt(text: str) -> PromptChange:
    kind, separator, value = text.partition(":")
    if kind in ("empty", "shuffled") and not separator:
        return PromptChange("empty" if kind == "empty" else "shuffled")
    if kind == "shuffled" and value.isdecimal():
        return PromptChange("shuffled", seed=int(value))
    if kind == "task" and value.isdecimal():
        return PromptChange("task", task_id=int(value))
    if kind == "text" and separator:
        if not value.strip():
            raise BadArgument(f"--prompt '{text}' has no text; give some behind the colon, or --prompt empty for none.")
        return PromptChange("text", text=value)
    if kind == "synonyms" and value:
        from vla_attention.capture.interventions.prompts import read_synonyms

        return PromptChange("synonyms", synonyms=read_synonyms(Path(value)))
    near = did_you_mean(text, [name.partition(":")[0] for name in _PROMPTS])
    raise BadArgument(f"Cannot use --prompt '{text}'.{near} Expected one of {listing(_PROMPTS)}.")


def _image(text: str) -> ImageChange:
    camera, _, change = (part.strip() for part in text.partition("="))
    kind, separator, value = change.partition(":")
    if camera:
        if kind in ("blank", "noise", "rotated") and not separator:
            return ImageChange(camera, kind)  # type: ignore[arg-type]  # one of the literals
        if kind == "noise" and value.isdecimal():
            return ImageChange(camera, "noise", seed=int(value))
        if kind in ("masked", "filled") and value:
            return ImageChange(camera, "masked" if kind == "masked" else "filled", object=value)
        if kind == "shifted":
            try:
                rows, columns = (int(number) for number in value.split(","))
                return ImageChange(camera, "shifted", rows=rows, columns=columns)
            except ValueError:
                pass  # the sentence below says what is expected
    raise BadArgument(f"Cannot read --image '{text}'; expected CAMERA= and one of {listing(_IMAGES)}.")
