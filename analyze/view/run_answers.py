"""What the page is told of whole runs: what was recorded, and what happened in every episode."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import Any, TypeAlias

from vla_attention.analyze.core.behaviour import verdict
from vla_attention.analyze.stores.contents import read_one_by_one
from vla_attention.analyze.stores.run_notes import change_notes, same_words, told_instruction
from vla_attention.schemas.errors import UserError
from vla_attention.schemas.safe_text import visible
from vla_attention.schemas.stores.reader import Store, StoredEpisode
from vla_attention.schemas.stores.store_format import parse_episode_name

#: By place of the store and name, an episode and its line.
KnownLines: TypeAlias = dict[tuple[str, str], tuple[StoredEpisode, dict[str, Any]]]


def runs_answer(stores: Sequence[Store], known: KnownLines, with_paths: bool = False) -> dict[str, Any]:
    """`runs.json`: the runs of the page, each with a line for every episode.

    Args:
        stores: of the runs.
        known: lines that stay of an episode that is the same object and could be read; new ones are added.
        with_paths: also where the stores are on this machine, for commands to copy; sites of others do not say it.
    """
    counts = Counter(store.path.name for store in stores)
    return {
        "runs": [
            {"name": store.path.name if counts[store.path.name] == 1 else str(store.path)}
            | _run_answer(store, known)
            | ({"path": str(store.path), "notes": list(store.notes)} if with_paths else {})
            for store in stores
        ]
    }


def _run_answer(store: Store, known: KnownLines) -> dict[str, Any]:
    root, place = store.attributes, str(store.path)

    def is_known(episode: StoredEpisode) -> bool:
        kept, line = known.get((place, episode.name), (None, {}))
        return kept is episode and "failed" not in line

    new = [episode for episode in store.episodes if not is_known(episode)]
    for episode, opened in zip(new, read_one_by_one(new), strict=True):
        known[place, episode.name] = episode, episode_line(store, opened)
    return {
        "policy": visible(root.policy.name),
        "suite": root.protocol.suite,
        "untrained": root.policy.untrained,
        "rerun": root.rerun_of is not None,
        "changed": list(change_notes([store])),
        "sites": [
            {
                "name": site.name,
                "keys": site.num_keys,
                "pictured": bool(site.pictured),
                "spelled": any(span.kind == "text" for span in site.spans),
                "layers": list(root.recording_of(site.name).layer_labels),
                "heads": list(root.recording_of(site.name).heads),
                "denoise_steps": list(root.recording.denoise_steps),
            }
            for site in root.sites
        ],
        "episodes": [known[place, episode.name][1] for episode in store.episodes],
    }


def episode_line(store: Store, episode: StoredEpisode) -> dict[str, Any]:
    """An episode in the list: what it was told and came to; of one that cannot be read its name, and why.

    picture: camera and replan of a stored picture that stands for it, the last one of the first camera.
    """
    task, number = parse_episode_name(episode.name)
    line: dict[str, Any] = {"name": episode.name, "task": task, "episode": number}
    try:
        attributes = episode.attributes
        told = told_instruction(store, attributes)
        pictured = [view.name for view in store.attributes.policy.cameras if episode.has(f"frames/{view.name}")]
        last, came_to = attributes.num_replans - 1, verdict(store, attributes)
        return line | {
            "instruction": visible(attributes.instruction),
            "told": visible(told),
            "told_other": not same_words(told, attributes.instruction),
            "outcome": attributes.success if store.attributes.rerun_of is None else None,
            "verdict": came_to.sentence,
            "did_other": came_to.other,
            "scene": attributes.scene_task_id,
            "num_steps": attributes.num_steps,
            "num_replans": attributes.num_replans,
            "picture": [pictured[0], last] if pictured and last >= 0 else None,
        }
    except UserError as error:
        return line | {"failed": str(error)}
