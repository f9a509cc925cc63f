"""What the episodes of a data set, or of a store, look like at the beginning, what they were told, and what was done.

Of each episode little is kept: small pictures, the first state, and sixteen moments of its actions.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from vla_attention.analyze.core.camera_maps import upright
from vla_attention.analyze.statistics.told_apart import Array, Look
from vla_attention.analyze.stores.run_notes import told_instruction
from vla_attention.schemas.data_sets.lerobot_dataset import LeRobotDataset, open_dataset
from vla_attention.schemas.episode_steps import EXECUTED
from vla_attention.schemas.errors import BadArgument
from vla_attention.schemas.groupings.words import folded_words
from vla_attention.schemas.progress_bar import progress_bar
from vla_attention.schemas.stores.reader import Store, StoredEpisode, open_store
from vla_attention.schemas.stores.store_url import is_store, store_place

Picture: TypeAlias = NDArray[np.uint8]
#: A look of the user's own: picture (height, width, 3) -> (number,).
Encoder: TypeAlias = Callable[[Picture], NDArray[np.floating]]
#: Without `num_episodes`: what matrices of (episode, episode) still do in minutes.
MOST_EPISODES = 5000
#: Moments at which actions are looked at, to the median length of the episodes.
MOMENTS = 16
#: Pixels of a side: of what is compared, of the picture whose edges are counted, and of the pictures that are shown.
_SMALL, _EDGES, _SHOWN = 8, 64, 96
#: Looks that are not of one camera.
FIRST_STATE, EVERYTHING, EVERYTHING_CURVED = "first state", "all of it", "all of it, curved"
_TINY = 1e-9
#: What names of cameras of a LeRobotDataset begin with, and nobody says.
_PREFIX = "observation.images."


@dataclass(frozen=True)
class DataEpisodes:
    """The episodes that were read.

    Attributes:
        name: of the data set or store.
        total: how many there are.
        sentences: (episode,) what each was told: its words in lower case.
        written: sentence -> how often it is written in which way.
        several: episodes in which more than one sentence is told; that of the first frame counts.
        cameras, state: what was looked at.
        looks: what the beginnings look like, by name.
        pictures: sentence -> a first picture of the first camera, small.
        motions: (moment, episode, number), what was done until then; None without actions and states.
        moments: (moment,) in `unit`.
        unit: "s", or "steps" of a simulator.
    """

    name: str
    total: int
    sentences: tuple[str, ...]
    written: Mapping[str, Counter[str]]
    several: int
    cameras: tuple[str, ...]
    state: str
    looks: Mapping[str, Look]
    pictures: Mapping[str, Picture]
    motions: Array | None
    moments: Array
    unit: str


@dataclass(frozen=True)
class Episode:
    """What is read of one episode.

    instruction: as it is written. several: whether another one is told later. images: camera -> the first picture.
    state: the first one, (number,). actions, states: (time, number), if they are known. times: (time,).
    """

    instruction: str
    several: bool
    images: Mapping[str, Picture]
    state: Array
    actions: Array | None
    times: Array
    states: Array | None


def read_episodes(place: str | Path, num_episodes: int | None = None, encoder: Encoder | None = None) -> DataEpisodes:
    """Read a data set (a folder, `ORG/NAME`) or a store; a bar shows progress at a terminal.

    num_episodes: so many of them, evenly over all; None: all, `MOST_EPISODES` at most. encoder: one more look.

    Raises:
        DataSetError, StoreError: it cannot be read.
        BadArgument: it has no pictures, or fewer than one episode was asked for.
    """
    if num_episodes is not None and num_episodes < 1:
        raise BadArgument(f"--num-episodes is {num_episodes}; expected at least 1.")
    most = num_episodes or MOST_EPISODES
    if is_store(str(place)) or (Path(place) / "zarr.json").is_file():
        store = open_store(store_place(str(place)))
        chosen = _spread(store.episodes, most)
        moments = _moments([one.attributes.num_steps for one in chosen])
        return collected(
            store.suite, len(store.episodes), len(chosen), _of_store(store, chosen), moments, "steps", encoder
        )
    data = open_dataset(place)
    numbers = _spread(data.episode_numbers, most)
    data.check_files(numbers, data.cameras)
    moments = _moments([data.entry(number).length for number in numbers]) / data.fps
    episodes = _of_data_set(data, numbers)
    return collected(data.name, len(data.episode_numbers), len(numbers), episodes, moments, "s", encoder)


def _moments(lengths: Sequence[int]) -> Array:
    """Ends of sixteen parts of an episode of the median length."""
    return np.arange(1, MOMENTS + 1) / MOMENTS * (float(np.median(lengths)) if lengths else 0.0)


def _spread(all_of_them: Sequence, most: int) -> list:  # type: ignore[type-arg]
    """So many, evenly over all: tasks are often recorded one after the other."""
    places = np.unique(np.linspace(0, len(all_of_them) - 1, min(most, len(all_of_them))).round().astype(int))
    return [all_of_them[place] for place in places]


def _of_data_set(data: LeRobotDataset, numbers: Sequence[int]) -> Iterator[Episode]:
    numeric = [name for name, feature in data.features.items() if feature.dtype.startswith(("float", "int", "uint"))]
    states = [name for name in numeric if "state" in name and len(data.feature(name).shape) <= 1]
    actions = [name for name in numeric if name.split(".")[0] == "action" and len(data.feature(name).shape) <= 1]
    for number in numbers:
        episode = data.episode(number)
        first = next(episode.frames(cameras=data.cameras))
        state = np.concatenate([np.zeros((episode.length, 0)), *(episode.column(name) for name in states)], axis=1)
        action = np.concatenate([episode.column(name) for name in actions], axis=1) if actions else None
        several = len(np.unique(episode.task_indices)) > 1
        yield Episode(first.instruction, several, first.images, state[0], action, episode.seconds, state)


def _of_store(store: Store, chosen: Sequence[StoredEpisode]) -> Iterator[Episode]:
    for episode in chosen:
        attributes = episode.attributes
        images = {
            view.name: upright(episode.read(f"frames/{view.name}", 0), view)
            for view in store.attributes.policy.cameras
            if episode.has(f"frames/{view.name}")
        }
        state = episode.read("state", 0) if episode.has("state") else np.zeros(0)
        actions = episode.read(EXECUTED) if episode.has(EXECUTED) else None
        times = np.arange(0 if actions is None else len(actions), dtype=np.float64)
        yield Episode(told_instruction(store, attributes), False, images, state, actions, times, None)
        episode.forget()


def collected(
    name: str,
    total: int,
    number: int,
    episodes: Iterator[Episode],
    moments: Array,
    unit: str,
    encoder: Encoder | None = None,
) -> DataEpisodes:
    """What is kept of episodes that are read one after the other.

    Args:
        name: of the data set or store.
        total: how many episodes it has.
        number: how many are read.
        episodes: those.
        moments: (moment,) at which actions are looked at.
        unit: of the moments.
        encoder: one more look at each picture.
    """
    sentences: list[str] = []
    written: dict[str, Counter[str]] = {}
    small: dict[str, list[Array]] = {}
    encoded: dict[str, list[Array]] = {}
    shown: dict[str, Picture] = {}
    states, motions, several = [], [], 0
    with progress_bar(number, "episodes") as advance:
        for episode in episodes:
            sentence = " ".join(folded_words(episode.instruction))
            if not episode.images or (small and episode.images.keys() != small.keys()):
                have = ", ".join(episode.images) or "none"
                raise BadArgument(
                    f"An episode of '{name}' has pictures of the cameras {have}; expected those of all others, "
                    f"{', '.join(small) or 'at least one'}: the first picture is what is asked about."
                )
            for camera, picture in episode.images.items():
                small.setdefault(camera, []).append(_small(picture))
                if encoder is not None:
                    encoded.setdefault(camera, []).append(np.asarray(encoder(picture), dtype=np.float64).ravel())
            if sentence not in shown:
                shown[sentence] = _resized(next(iter(episode.images.values())), _SHOWN)
            written.setdefault(sentence, Counter())[episode.instruction.strip()] += 1
            sentences.append(sentence)
            states.append(episode.state)
            several += episode.several
            motions.append(_motion(episode, moments))
            advance(1)
    known = [one for one in motions if one is not None]
    even = len({one.shape for one in known}) == 1 and len(known) == number
    return DataEpisodes(
        name,
        total,
        tuple(sentences),
        written,
        several,
        tuple(camera.removeprefix(_PREFIX) for camera in small),
        _size(states),
        _looks(_stacked(small), _stacked(encoded), states),
        shown,
        np.stack(known, axis=1) if even else None,
        moments,
        unit,
    )


def _stacked(of: Mapping[str, Sequence[Array]]) -> dict[str, Array]:
    return {camera: np.stack(numbers) for camera, numbers in of.items()}


def _size(states: Sequence[Array]) -> str:
    sizes = {len(state) for state in states}
    return f"{sizes.pop()} numbers" if len(sizes) == 1 and sizes != {0} else ""


def _small(picture: Picture) -> Array:
    """8 x 8 colours, 8 x 8 means of edges, mean and spread of each colour: (192 + 64 + 6,)."""
    shares = np.asarray(_resized(picture, _SMALL), dtype=np.float64) / 255
    fine = np.asarray(_resized(picture, _EDGES), dtype=np.float64) / 255
    grey = fine.mean(axis=2)
    edges = np.zeros_like(grey)
    edges[1:] += np.abs(np.diff(grey, axis=0))
    edges[:, 1:] += np.abs(np.diff(grey, axis=1))
    cell = _EDGES // _SMALL
    means = edges.reshape(_SMALL, cell, _SMALL, cell).mean(axis=(1, 3))
    return np.concatenate([shares.ravel(), means.ravel(), fine.mean(axis=(0, 1)), fine.std(axis=(0, 1))])


def _resized(picture: Picture, side: int) -> Picture:
    from PIL import Image

    return np.asarray(Image.fromarray(picture).resize((side, side), Image.Resampling.BOX))


def _looks(small: Mapping[str, Array], encoded: Mapping[str, Array], states: Sequence[Array]) -> dict[str, Look]:
    """The looks, of numbers with a mean square norm of 1; what is the same in all episodes tells nothing."""
    looks, blocks = {}, []
    for camera, numbers in small.items():
        colours, edges, whole = np.split(numbers, [3 * _SMALL**2, 4 * _SMALL**2], axis=1)
        block = _scaled(np.concatenate([_scaled(colours), _scaled(edges)], axis=1))
        short = camera.removeprefix(_PREFIX)
        looks[f"picture of {short}"] = Look(block)
        looks[f"brightness of {short}"] = Look(_standard(whole), curved=True)
        blocks.append(block)
    for camera, numbers in encoded.items():
        blocks.append(_scaled(_standard(numbers)))
        looks[f"encoder of {camera.removeprefix(_PREFIX)}"] = Look(blocks[-1])
    if len({len(state) for state in states}) == 1 and len(states[0]):
        blocks.append(_scaled(_standard(np.stack(states))))
        looks[FIRST_STATE] = Look(blocks[-1], curved=True)
    whole = np.concatenate(blocks, axis=1)
    looks |= {EVERYTHING: Look(whole)} if len(blocks) > 1 else {}
    looks[EVERYTHING_CURVED] = Look(whole, curved=True)
    known = {name: one for name, one in looks.items() if one.numbers.any()} or looks
    return {name: Look(one.numbers.astype(np.float32), one.curved) for name, one in known.items()}


def _standard(numbers: Array) -> Array:
    standard: Array = (numbers - numbers.mean(axis=0)) / (numbers.std(axis=0) + 1e-6)
    return standard


def _scaled(numbers: Array) -> Array:
    apart = numbers - numbers.mean(axis=0)
    norm: Array = apart / max(float(np.sqrt(np.square(apart).sum(axis=1).mean())), _TINY)
    return norm


def _motion(episode: Episode, moments: Array) -> Array | None:
    """(moment, number): the mean action since the beginning, that since the moment before, and the state then."""
    parts = []
    if len(episode.times) < 2:
        return None
    ends = np.clip(np.searchsorted(episode.times, moments), 1, None)
    if episode.actions is not None and len(episode.actions):
        ends = np.minimum(ends, len(episode.actions))
        sums = np.concatenate([np.zeros((1, episode.actions.shape[1])), episode.actions.cumsum(axis=0)])
        steps = [(min(begin, end - 1), end) for begin, end in pairwise([0, *ends])]
        parts += [sums[ends] / ends[:, None], np.stack([(sums[b] - sums[a]) / (b - a) for a, b in steps])]
    if episode.states is not None and episode.states.shape[1]:
        parts.append(episode.states[np.minimum(ends, len(episode.states)) - 1])
    if not parts:
        return None
    motion: Array = np.concatenate(parts, axis=1)
    return motion


def looks_of_motion(data: DataEpisodes, moment: int) -> list[Look]:
    """What was done until a moment, as looks."""
    assert data.motions is not None
    numbers = _scaled(_standard(data.motions[moment].astype(np.float64)))
    return [Look(numbers), Look(numbers, curved=True)]
