"""The store whose policy calls are made again: which of its episodes, by which policy, and what forbids it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

from vla_attention.capture.machine import POLICY_BATCH
from vla_attention.capture.rerun.stored_calls import StoreWithoutInputs
from vla_attention.schemas.errors import BadArgument, UserError, listing
from vla_attention.schemas.interventions import Interventions
from vla_attention.schemas.jsonable import to_json
from vla_attention.schemas.options import resolve_tasks
from vla_attention.schemas.stores.reader import Store, open_store
from vla_attention.schemas.stores.store_format import (
    CorruptEpisode,
    PolicyIdentity,
    RootAttributes,
    StoreError,
    parse_episode_name,
)
from vla_attention.schemas.stores.verify import look_at


def open_base(path: Path, chosen: Sequence[int | str] | None = None, num_episodes: int | None = None) -> Store:
    """Open a store with the wanted episodes only, all of them whole as far as a look tells.

    chosen: tasks, by number or by instruction. num_episodes: so many of each task, those with the lowest indices.

    Raises:
        StoreWithoutInputs: it was captured without pictures.
        CorruptEpisode: one of the episodes is damaged.
        BadArgument: it has no episode of a wanted task.
    """
    store = open_store(path)
    task_ids = None
    if chosen is not None:
        named = any(isinstance(task, str) for task in chosen)
        known = {one.attributes.task_id: one.attributes.instruction for one in store.episodes} if named else {}
        task_ids = resolve_tasks(chosen, known, str(path))
    for task_id in task_ids or ():
        if task_id not in store.task_ids:
            raise BadArgument(
                f"The store {path} has no episode of task {task_id}; it has tasks {listing(store.task_ids)}."
            )
    if not store.episodes:
        raise StoreError(f"The store {path} holds no episode; nothing can be run again.")
    if not store.attributes.recording.frames:
        raise StoreWithoutInputs(
            f"Cannot rerun {path}: it has no pictures (it was captured with --no-frames, or is a copy without them); "
            "capture with pictures, or use the store that was copied."
        )
    kept, of_task = [], dict.fromkeys(store.task_ids, 0)
    for episode in store.episodes:
        task_id, _ = parse_episode_name(episode.name)
        wanted = task_ids is None or task_id in task_ids
        if wanted and (num_episodes is None or of_task[task_id] < num_episodes):
            of_task[task_id] += 1
            kept.append(episode)
    for episode in kept:
        damaged = look_at(store, episode)
        if damaged is not None:
            raise CorruptEpisode(
                f"Cannot rerun {path}: {damaged.describe().rstrip('.')}; vla-attention capture verify --repair moves "
                "such ones "
                "aside."
            )
    return replace(store, episodes=tuple(kept))


def instructions_of(store: Store) -> dict[int, str]:
    """Return the instruction of each task that the whole store has an episode of, by task id.

    Also of tasks that `open_base` was not asked for: the prompt of another task is one. Of those, damaged episodes are
    left out, which are not run again.
    """
    instructions = {episode.attributes.task_id: episode.attributes.instruction for episode in store.episodes}
    for episode in open_store(store.path).episodes:
        task_id, _ = parse_episode_name(episode.name)
        if task_id not in instructions:
            with suppress(CorruptEpisode):
                instructions[task_id] = episode.attributes.instruction
    return instructions


def families_of(store: Store) -> list[tuple[int, str, str]]:
    """Return number, instruction and family of each task that the whole store has an episode of, as `instructions_of`.

    Without the tasks that `open_base` was not asked for, words would be exchanged for others, depending on them.
    """
    known: dict[int, tuple[int, str, str]] = {}
    for episode in open_store(store.path).episodes:
        with suppress(CorruptEpisode):
            of = episode.attributes
            known.setdefault(of.task_id, (of.task_id, of.instruction, of.task_family))
    return [known[number] for number in sorted(known)]


def scenes_of(store: Store) -> dict[int, dict[int, str]]:
    """Return the instructions of the tasks that share a task's scene, where the store's steps say it; by task."""
    scenes = {}
    for episode in open_store(store.path).episodes:
        with suppress(CorruptEpisode):
            if (steps := episode.attributes.steps) is not None:
                scenes[episode.attributes.task_id] = {goal.task_id: goal.instruction for goal in steps.goals}
    return scenes


def check_may_change(store: Store, interventions: Interventions) -> None:
    """Raise `StoreError` for interventions on a store whose own run had some already."""
    stored = store.attributes.interventions
    if stored.is_none or interventions.is_none:
        return
    source = store.attributes.rerun_of
    base = f"; its base is {source.name}" if source is not None else ""
    raise StoreError(
        f"Cannot change the policy calls of {store.path} once more: its run had interventions already "
        f"({stored.describe()}){base}; give a store without interventions."
    )


#: Fields of a policy's identity that name places, or where a configuration came from; they decide no number.
_PLACES = ("name", "checkpoint", "config.configuration", "config.text_encoder")


class OtherPolicy(UserError, ValueError):
    """The policy is another one than that of the store."""


def check_same_policy(store: Store, identity: PolicyIdentity, sites: object) -> None:
    """Raise `OtherPolicy` unless weights, configuration and layout are those of the store.

    Facts that a later version of this program added to the configuration are not in the store, and are not compared.
    """
    root: RootAttributes = store.attributes
    stored = root.policy
    if identity.digest != stored.digest:
        raise OtherPolicy(
            f"Cannot rerun {store.path}: its weights have the digest {stored.digest[:12]} ({stored.name}: "
            f"{stored.checkpoint}), and those of '{identity.checkpoint}' have {identity.digest[:12]}; give the "
            "--checkpoint that was captured."
        )
    difference = _first_difference(to_json(stored), to_json(identity), "")
    if difference is None and to_json(root.sites) != to_json(sites):
        difference = "sites", "the one", "another"
    if difference is not None:
        where, old, new = difference
        raise OtherPolicy(
            f"Cannot rerun {store.path}: its policy has the {where} {old!r}, and this one has {new!r}; give the model "
            "options of the capture."
        )


def _first_difference(old: object, new: object, where: str) -> tuple[str, object, object] | None:
    if where in _PLACES:
        return None
    if isinstance(old, Mapping) and isinstance(new, Mapping):
        for key, value in old.items():
            difference = _first_difference(value, new.get(key), f"{where}.{key}".lstrip("."))
            if difference:
                return difference
        return None
    return None if old == new else (where, old, new)


def machine_differences(then: Mapping[str, str], now: Mapping[str, str]) -> list[str]:
    """Return what differs between the machine of an episode and this one, as `torch 2.9 then, 2.10 now`."""
    single = {POLICY_BATCH: "1"}
    then, now = single | dict(then), single | dict(now)
    facts = [name for name in then if name in now and then[name] != now[name]]
    return [f"{name} {then[name]} then, {now[name]} now" for name in facts]
