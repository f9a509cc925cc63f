"""Whether an episode is there at all, looked at cheaply: its seal, its metadata, and the sizes of its files.

`--resume`, `status`, `repair` and `verify --quick` ask this of every episode. `verify.py` reads everything.
"""

from __future__ import annotations

from vla_attention.schemas.stores.episode_files import links_in_episode
from vla_attention.schemas.stores.foreign_files import links_beyond_seal
from vla_attention.schemas.stores.reader import StoredEpisode
from vla_attention.schemas.stores.store_format import CorruptEpisode, Problem


def check_presence(episode: StoredEpisode) -> list[Problem]:
    """What is wrong with an episode; an empty list means that it is present.

    Looked at are the seal, the episode's name and run, every `zarr.json`, the presence and size of every file, and that
    nothing in the episode is a link; the content of arrays is not read.
    """
    try:
        _ = episode.attributes
    except CorruptEpisode as error:
        return [Problem(str(error), error.file)]
    said = {path: f"its {path} is a link" for path in links_in_episode(episode)}
    said |= {
        path: f"its {path} is a link, which its seal does not list; remove it" for path in links_beyond_seal(episode)
    }
    said |= {file: problem for file, problem in episode.files.problems().items() if file not in said}
    problems = [Problem(f"Episode {episode.name} is damaged: {problem}.", file) for file, problem in said.items()]
    for file in episode.files.records:
        if file.endswith("zarr.json") and file not in said:
            try:
                episode.sealed(file)
            except CorruptEpisode as error:
                problems.append(Problem(str(error), error.file))
    return problems
