"""What every answer says of a run whose policy did not read the task's instruction, or not all of it."""

from __future__ import annotations

from collections.abc import Iterable

from vla_attention.schemas.errors import listing, plural
from vla_attention.schemas.layout import Prompt
from vla_attention.schemas.safe_text import visible
from vla_attention.schemas.stores.reader import Store, StoredEpisode


def prompt_notes(episodes: Iterable[tuple[Store, StoredEpisode]]) -> tuple[str, ...]:
    """A line on each store whose prompts were replaced, and on each in which prompts were cut; empty without any."""
    stores: dict[str, tuple[Store, list[StoredEpisode]]] = {}
    for store, episode in episodes:
        stores.setdefault(str(store.path), (store, []))[1].append(episode)
    notes = []
    for store, of_store in stores.values():
        change = store.attributes.interventions.prompt
        if change is not None:
            notes.append(
                f"The policy read another instruction than the task's in {store.path.name}: {change.describe()}."
            )
        cut = {episode.name: lost for episode in of_store if (lost := _never_read(episode.attributes.prompts))}
        if cut:
            notes.append(
                f"Prompts were cut in {store.path.name}: in {plural(len(cut), 'episode')} the policy never read the "
                f"end of its prompt ({listing([f'{lost!r}' for lost in dict.fromkeys(cut.values())], 3)})."
            )
    return tuple(notes)


def _never_read(prompts: Iterable[Prompt]) -> str:
    """The end of a prompt behind its last piece; empty where all of it was read, or where nobody knows."""
    for prompt in prompts:
        lost = prompt.text[max((piece.stop for piece in prompt.pieces), default=len(prompt.text)) :]
        if lost.strip():
            return visible(lost.strip())
    return ""
