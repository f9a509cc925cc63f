"""What every answer says of a run that was changed, and of one whose policy did not read all of its prompt."""

from __future__ import annotations

from collections.abc import Iterable

from vla_attention.schemas.errors import listing, plural
from vla_attention.schemas.layout import Prompt
from vla_attention.schemas.safe_text import visible
from vla_attention.schemas.stores.reader import Store, StoredEpisode

Episodes = Iterable[tuple[Store, StoredEpisode]]


def run_notes(episodes: Episodes) -> tuple[str, ...]:
    """A line on each store whose run was changed, and on each in which prompts were cut; empty without any."""
    episodes = list(episodes)
    stores = {str(store.path): store for store, _ in episodes}
    return (*change_notes(stores.values()), *cut_notes(episodes))


def change_notes(stores: Iterable[Store]) -> tuple[str, ...]:
    """A line on each store whose run was changed, from its root alone; empty without any."""
    return tuple(
        f"The run in {store.path.name} was changed: {visible(store.attributes.interventions.describe())}."
        for store in stores
        if not store.attributes.interventions.is_none
    )


def cut_notes(episodes: Episodes) -> tuple[str, ...]:
    """A line on each store in which prompts were cut; empty without any."""
    lost: dict[str, list[str]] = {}
    for store, episode in episodes:
        if end := _never_read(episode.attributes.prompts):
            lost.setdefault(store.path.name, []).append(end)
    return tuple(
        f"Prompts were cut in {name}: in {plural(len(ends), 'episode')} the policy never read the end of its prompt "
        f"({listing([f'{end!r}' for end in dict.fromkeys(ends)], 3)})."
        for name, ends in lost.items()
    )


def _never_read(prompts: Iterable[Prompt]) -> str:
    """The end of a prompt behind its last piece; empty where all of it was read, or where nobody knows."""
    for prompt in prompts:
        lost = prompt.text[prompt.pieces[-1].stop :] if prompt.pieces else ""
        if lost.strip():
            return visible(lost.strip())
    return ""
