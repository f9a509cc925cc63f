"""The stores of `vla-attention effects`: the base, its reruns, and rollouts with interventions."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from vla_attention.analyze.effects.conditions import Condition
from vla_attention.schemas.errors import BadArgument, listing
from vla_attention.schemas.interventions import Interventions
from vla_attention.schemas.safe_text import visible
from vla_attention.schemas.stores.reader import Store, open_store
from vla_attention.schemas.stores.store_format import STORE_SUFFIX, StoreNotFound
from vla_attention.schemas.stores.store_url import StorePlace

#: So many digits of a run's digest tell runs apart in a message.
_DIGITS = 12


@dataclass(frozen=True)
class BaseAndReruns:
    """A base run with what is compared with it.

    Attributes:
        base: its store.
        reruns: the stores whose replans are those of the base, under interventions.
        rollouts: new rollouts with interventions, which share initial states with the base.
        notes: a line for every store of a folder that is neither.
    """

    base: Store
    reruns: tuple[Condition, ...]
    rollouts: tuple[Condition, ...]
    notes: tuple[str, ...]


def open_reruns(base: Store, given: Sequence[StorePlace]) -> BaseAndReruns:
    """Open what is compared with a base: stores, or folders of stores.

    Raises:
        BadArgument: a store that was given by its own path belongs to another base or changes nothing, a folder holds
            nothing of this base, or a rollout is of another policy or suite.
        StoreNotFound, StoreError: see `vla_attention.schemas.stores.reader.open_store`.
    """
    if not given:
        recorded = recorded_conditions(base)
        if not recorded:
            raise BadArgument(
                f"{base.path} holds no effects, and no rerun of it was given; make a store with them with "
                f"vla-attention capture rerun {base.path} --effects text,cameras, or give reruns, for instance the "
                f"folder of vla-attention capture rerun {base.path} --series default."
            )
        return BaseAndReruns(base, recorded, (), ())
    reruns, rollouts, notes = [], [], []
    for path, named in _paths(given):
        other = open_store(path)
        if path.resolve() == base.path.resolve():
            if named:
                raise BadArgument(f"The store {path} is given as the base and as its rerun; give reruns of it.")
            continue
        problem = _problem(base, other)
        if problem and named:
            raise BadArgument(f"{path} {problem}; {_what_fits(base.path)}.")
        if problem:
            notes.append(f"{path} is left out: it {problem}.")
        elif other.attributes.rerun_of is not None:
            reruns.append(other)
            if other.attributes.interventions.is_none and recorded_conditions(other):
                notes.append(f"{path} holds effects of its own: vla-attention effects {path} shows them.")
        else:
            rollouts.append(other)
    if len(notes) == len(reruns) == 1 and not rollouts and recorded_conditions(reruns[0]):
        raise BadArgument(f"{reruns[0].path} changes nothing that {base.path} does not. {notes[0]}")
    if not reruns and not rollouts:
        raise BadArgument(
            f"{listing(given)} {'holds' if len(given) == 1 else 'hold'} no rerun of {base.path} "
            f"({notes[0] if notes else 'only the base itself'}); {_what_fits(base.path)}."
        )
    names = _names([*reruns, *rollouts])
    conditions = [
        Condition(name, other, other.attributes.interventions)
        for name, other in zip(names, [*reruns, *rollouts], strict=True)
    ]
    return BaseAndReruns(base, tuple(conditions[: len(reruns)]), tuple(conditions[len(reruns) :]), tuple(notes))


def recorded_conditions(base: Store) -> tuple[Condition, ...]:
    """The conditions whose effects a store measured beside its calls, in the order of its episodes."""
    if base.attributes.recording.effects is None:
        return ()
    conditions: dict[str, Interventions] = {}
    for episode in base.episodes:
        if (effects := episode.attributes.effects) is not None:
            for one in effects.conditions:
                conditions.setdefault(one.name, one)
    return tuple(Condition(visible(name), base, one, recorded=True) for name, one in conditions.items())


def _what_fits(base: StorePlace) -> str:
    return f"make reruns with vla-attention capture rerun {base}, or roll out with its settings and an intervention"


def _problem(base: Store, other: Store) -> str:
    """Why a store is neither a rerun of the base nor a rollout that can be paired with it; empty when it is."""
    source, root = other.attributes.rerun_of, other.attributes
    if source is not None:
        if source.run == base.run:
            return ""
        return (
            f"is a rerun of '{visible(source.name)}' (run {source.run[:_DIGITS]}), not of {base.path} "
            f"(run {base.run[:_DIGITS]})"
        )
    if root.interventions.is_none:
        return f"is no rerun: it does not name a run that it repeats, and changes nothing that {base.path} does not"
    mine = base.attributes
    for what, first, second in (
        ("weights", mine.policy.digest, root.policy.digest),
        ("suite", mine.protocol.suite, root.protocol.suite),
        ("number of steps between replans", mine.protocol.replan_steps, root.protocol.replan_steps),
        ("most steps", mine.protocol.max_steps, root.protocol.max_steps),
    ):
        if first != second:
            return f"is a rollout with another {what} than {base.path} ({_short(second)}, not {_short(first)})"
    return ""


def _short(value: object) -> str:
    text = str(value)
    return text if len(text) <= 2 * _DIGITS else text[:_DIGITS]


def _paths(given: Sequence[StorePlace]) -> list[tuple[StorePlace, bool]]:
    """Paths of stores, and whether each was named itself; the others are in a folder that was given."""
    paths: list[tuple[StorePlace, bool]] = []
    for path in given:
        if isinstance(path, Path) and path.is_dir() and not (path / "zarr.json").exists():
            inside = sorted(entry for entry in path.iterdir() if entry.suffix == STORE_SUFFIX and entry.is_dir())
            if not inside:
                raise StoreNotFound(
                    f"The folder {path} holds no store; expected those of vla-attention capture rerun --series "
                    "--output-dir "
                    f"{path}, or the path of a NAME.zarr."
                )
            paths += [(entry, False) for entry in inside]
        else:
            paths.append((path, True))
    once = {path.resolve(): (path, named) for path, named in paths}
    return list(once.values())


def _names(stores: Sequence[Store]) -> list[str]:
    """A name for each store: that of its interventions, or where two are alike or empty, that of its file."""
    names = [visible(store.attributes.interventions.name) or store.path.stem for store in stores]
    files = [store.path.stem if names.count(name) > 1 else name for name, store in zip(names, stores, strict=True)]
    return [str(store.path) if files.count(name) > 1 else name for name, store in zip(files, stores, strict=True)]
