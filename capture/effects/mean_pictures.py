"""The mean picture of each camera in a task's stored episodes: what a camera's own picture is exchanged for."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from vla_attention.capture.effects.arguments import EffectSettings
from vla_attention.capture.policies.policy import Policy
from vla_attention.schemas.errors import BadArgument, listing
from vla_attention.schemas.layout import picture_size
from vla_attention.schemas.stores.reader import Store, StoredEpisode, open_store

#: Pictures of an episode that count, evenly over its replans: neighbours look alike, and each takes a millisecond.
_OF_EPISODE = 8


@dataclass(frozen=True)
class MeanPictures:
    """Mean pictures by task and camera, from the stored pictures of one store.

    cameras: of the policy, those of which the store has pictures that fit.
    """

    store: Store
    cameras: tuple[str, ...]
    _known: dict[int, dict[str, NDArray[np.uint8]]] = field(default_factory=dict, compare=False)

    def of_task(self, task_id: int) -> dict[str, NDArray[np.uint8]]:
        """Return camera -> (height, width, 3) as the model sees it; empty where the store has no such episode."""
        if task_id not in self._known:
            episodes = [one for one in self.store.episodes if one.attributes.task_id == task_id]
            self._known[task_id] = {camera: _mean(episodes, camera) for camera in self.cameras if episodes}
        return self._known[task_id]


def pictures_of(
    settings: EffectSettings | None, policy: Policy, suite: str, base: Store | None = None
) -> MeanPictures | None:
    """Return the mean pictures that effects of cameras exchange pictures for; None for grey ones.

    base: the store that is run again, whose pictures are taken unless a store is named.

    Raises:
        BadArgument: the named store is of another suite, or lacks pictures of a camera, or has them of another size.
    """
    if settings is None or "cameras" not in settings.items:
        return None
    named = settings.pictures is not None
    store = base if settings.pictures is None else open_store(settings.pictures)
    if store is None:
        return None
    if store.suite != suite:
        raise BadArgument(
            f"Cannot take mean pictures of '{suite}' from {store.path}, whose tasks are of '{store.suite}'."
        )
    fitting = []
    for camera in (view.name for view in policy.cameras):
        wanted = (*picture_size(policy.sites, camera), 3)
        shapes = {
            tuple(one.attributes.arrays[f"frames/{camera}"].shape[1:]) if one.has(f"frames/{camera}") else ()
            for one in store.episodes
        }
        if shapes == {wanted}:
            fitting.append(camera)
        elif named:
            found = listing(sorted("none" if not shape else " x ".join(map(str, shape)) for shape in shapes)) or "none"
            raise BadArgument(
                f"Cannot take mean pictures of camera '{camera}' from {store.path}: expected pictures of "
                f"{' x '.join(map(str, wanted))} in every episode, and there are {found}."
            )
    return MeanPictures(store, tuple(fitting))


def _mean(episodes: Sequence[StoredEpisode], camera: str) -> NDArray[np.uint8]:
    """Every episode weighs the same."""
    means = []
    for episode in episodes:
        count = episode.attributes.num_replans
        chosen = np.unique(np.linspace(0, count - 1, min(count, _OF_EPISODE)).round().astype(int))
        means.append(np.mean([episode.read(f"frames/{camera}", int(replan)) for replan in chosen], axis=0))
    mean: NDArray[np.uint8] = np.rint(np.mean(means, axis=0)).astype(np.uint8)
    return mean
