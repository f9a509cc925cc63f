"""The options of interventions on the command line. Imports nothing heavy: every `--help` needs them."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
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

#: Who does not read what is knocked out, unless the command line says it.
DEFAULT_QUERIES = "action"
_QUERIES = ("action", "all", "prefix", "prefix:SELECTOR")
_PROMPTS = ("empty", "shuffled", "shuffled:SEED", "task:N", "text:TEXT", "synonyms:FILE")
_IMAGES = ("blank", "noise", "noise:SEED", "rotated", "shifted:ROWS,COLUMNS", "masked:OBJECT", "filled:OBJECT")


def add_intervention_arguments(parser: argparse.ArgumentParser) -> None:
    """Add all options of interventions; `read_interventions` reads them."""
    group = parser.add_argument_group(
        "interventions", "what is changed in the policy, stored with the run (docs/interventions.md)"
    )
    group.add_argument(
        "--knockout",
        action="append",
        default=[],
        metavar="SELECTOR",
        help="keys that are not read: camera:NAME, word:NAME, object:NAME, role:NAME ..., joined by &, | and - as in "
        "groupings; may be given several times",
    )
    group.add_argument("--keep", metavar="SELECTOR", help="knock out all other valid keys, but no action keys")
    group.add_argument(
        "--knockout-queries",
        metavar="QUERIES",
        help="who does not read them: action (the action queries, the default but for the words of a series), all "
        "(every query that could carry the information on), prefix (pi: pictures and prompt only) or prefix:SELECTOR "
        "(those tokens of it)",
    )
    for name, what in (("layers", "layers"), ("heads", "attention heads"), ("steps", "denoise steps")):
        group.add_argument(
            f"--knockout-{name}",
            type=int,
            nargs="+",
            metavar="N",
            help=f"{what} in which attention changes, also for --attention (default: all)",
        )
    group.add_argument(
        "--knockout-weight",
        type=float,
        metavar="W",
        help="share of the attention that is taken away, 0 to 1 (default: 1, exactly all of it)",
    )
    group.add_argument(
        "--random-keys",
        type=int,
        metavar="SEED",
        help="the control: knock out equally many random keys outside of each group, drawn for every replan",
    )
    group.add_argument(
        "--attention",
        action="append",
        default=[],
        metavar="SELECTOR=CHANGE",
        help="multiply a group's attention before normalising (SELECTOR=0.5), or make it uniform inside the group "
        "(SELECTOR=uniform); may be given several times",
    )
    group.add_argument("--prompt", metavar="CHANGE", help=f"another instruction: {listing(_PROMPTS)}")
    group.add_argument(
        "--image",
        action="append",
        default=[],
        metavar="CAMERA=CHANGE",
        help=f"another picture of a camera: {listing(_IMAGES)}; may be given several times",
    )
    group.add_argument("--noise-seed", type=int, metavar="N", help="draw the policy's noise from this seed")
    group.add_argument(
        "--allow-empty",
        action="store_true",
        help="leave replans unchanged in which a group has no key, instead of stopping there",
    )


def read_interventions(arguments: argparse.Namespace, name: str = "") -> Interventions:
    """Return the interventions of parsed arguments, with layer numbers as given; `name` is that of the condition.

    Raises:
        BadArgument: an option cannot be read, or has nothing to act on.
    """
    queries, query_selector = _queries(arguments.knockout_queries or DEFAULT_QUERIES)
    places = {
        "layers": _numbers(arguments.knockout_layers),
        "heads": _numbers(arguments.knockout_heads),
        "denoise_steps": _numbers(arguments.knockout_steps),
    }
    knocked = [(selector, False) for selector in arguments.knockout]
    knocked += [(arguments.keep, True)] if arguments.keep is not None else []
    keys = tuple(
        KeyKnockout(
            selector,
            keep=keep,
            queries=queries,
            query_selector=query_selector,
            weight=1.0 if arguments.knockout_weight is None else arguments.knockout_weight,
            random_seed=arguments.random_keys,
            **places,
        )
        for selector, keep in knocked
    )
    if query_selector and arguments.attention:
        raise BadArgument("Cannot use --knockout-queries prefix:SELECTOR with --attention; use action, all or prefix.")
    attention = tuple(_attention(text, {"queries": queries, **places}) for text in arguments.attention)
    _refuse_idle(arguments, bool(keys), bool(keys or attention))
    return Interventions(
        name=name,
        keys=keys,
        attention=attention,
        prompt=None if arguments.prompt is None else _prompt(arguments.prompt),
        images=tuple(_image(text) for text in arguments.image),
        noise=None if arguments.noise_seed is None else NoiseChange(arguments.noise_seed),
    )


def _refuse_idle(arguments: argparse.Namespace, knocks_out: bool, changes_attention: bool) -> None:
    """Raise `BadArgument` for an option that nothing uses."""
    for option, given, used, needs in (
        ("--random-keys", arguments.random_keys is not None, knocks_out, "--knockout or --keep"),
        ("--knockout-weight", arguments.knockout_weight is not None, knocks_out, "--knockout or --keep"),
        ("--knockout-queries", arguments.knockout_queries is not None, changes_attention, "--knockout or --attention"),
        ("--knockout-layers", arguments.knockout_layers is not None, changes_attention, "--knockout or --attention"),
        ("--knockout-heads", arguments.knockout_heads is not None, changes_attention, "--knockout or --attention"),
        ("--knockout-steps", arguments.knockout_steps is not None, changes_attention, "--knockout or --attention"),
        ("--allow-empty", arguments.allow_empty, changes_attention or bool(arguments.image), "--knockout or --image"),
    ):
        if given and not used:
            raise BadArgument(f"{option} has nothing to act on; give {needs} too.")


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
