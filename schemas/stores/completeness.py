"""Whether an episode is there at all, looked at cheaply: its seal, its metadata, and the sizes of its files.

`--resume`, `status`, `repair` and `verify --quick` ask this of every episode. `verify.py` reads everything.
"""

from __future__ import annotations

from vla_attention.schemas.stores.episode_files import links_in_episode
from vla_attention.schemas.stores.foreign_files import links_beyond_seal
from vla_attention.schemas.stores.reader import StoredEpisode
from vla_attention.schemas.stores.store_format import CorruptEpisode


def check_presence(episode: StoredEpisode) -> list[str]:
    """What is wrong with an episode, one sentence each; an empty list means that it is present.

    Looked at are the seal, the episode's name and run, every `zarr.json`, the presence and size of every file, and that
    nothing in the episode is a link; the content of arrays is not read.
    """
    try:
        _ = episode.attributes
    except CorruptEpisode as error:
        return [str(error)]
    problems = [f"Episode {episode.name} is damaged: its {path} is a link." for path in links_in_episode(episode)]
    problems += [
        f"Episode {episode.name} is damaged: its {path} is a link, which its seal does not list; remove it."
        for path in links_beyond_seal(episode)
    ]
    problems += [f"Episode {episode.name} is damaged: {problem}." for problem in episode.files.problems()]
    for file in episode.files.records:
        if file.endswith("zarr.json") and not any(file in problem for problem in problems):
            try:
                episode.sealed(file)
            except CorruptEpisode as error:
                problems.append(str(error))
    return problems
