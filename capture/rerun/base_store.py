"""The store whose policy calls are made again: which of its episodes, and what forbids it."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

from vla_attention.capture.rerun.stored_calls import StoreWithoutInputs
from vla_attention.schemas.errors import BadArgument, listing
from vla_attention.schemas.interventions import Interventions
from vla_attention.schemas.stores.damaged_episodes import look_at
from vla_attention.schemas.stores.reader import Store, open_store
from vla_attention.schemas.stores.store_format import CorruptEpisode, StoreError, parse_episode_name


def open_base(path: Path, task_ids: Sequence[int] | None = None, num_episodes: int | None = None) -> Store:
    """Open a store with the wanted episodes only, all of them whole as far as a look tells.

    num_episodes: so many of each task, those with the lowest indices.

    Raises:
        StoreWithoutInputs: it was captured without pictures.
        CorruptEpisode: one of the episodes is damaged.
        BadArgument: it has no episode of a wanted task.
    """
    store = open_store(path)
    if num_episodes is not None and num_episodes < 1:
        raise BadArgument(f"Cannot use --num-episodes {num_episodes}; expected at least 1.")
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
        damaged = look_at(store, episode, read_only=True)
        if damaged is not None:
            raise CorruptEpisode(
                f"Cannot rerun {path}: {damaged.describe().rstrip('.')}; vla-capture repair moves such episodes aside."
            )
    return replace(store, episodes=tuple(kept))


def instructions_of(store: Store) -> dict[int, str]:
    """Return the instruction of each task that the whole store has an episode of, by task id.

    Also of tasks that `open_base` was not asked for: the prompt of another task is one. Of those, damaged episodes are
    left out, which are not run again.
    """
    found = {episode.attributes.task_id: episode.attributes.instruction for episode in store.episodes}
    for episode in open_store(store.path).episodes:
        task_id, _ = parse_episode_name(episode.name)
        if task_id not in found:
            with suppress(CorruptEpisode):
                found[task_id] = episode.attributes.instruction
    return found


def check_may_change(store: Store, interventions: Interventions) -> None:
    """Raise `StoreError` for interventions on a store whose own run had some already."""
    own = store.attributes.interventions
    if own.is_none or interventions.is_none:
        return
    source = store.attributes.rerun_of
    base = f"; its base is {source.name}" if source is not None else ""
    raise StoreError(
        f"Cannot change the policy calls of {store.path} once more: its run had interventions already "
        f"({own.describe()}){base}; give a store without interventions."
    )
