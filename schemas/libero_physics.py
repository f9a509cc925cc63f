"""With which MuJoCo LIBERO's published evaluations were simulated, and what another one does to its scenes.

LIBERO's initial states are from before objects settle. MuJoCo 3.4 mended contacts between boxes, and since then they
settle elsewhere: the bowl of `libero_spatial` task 5 slides off the ramekin. Since 3.3.3 floors are drawn darker.
`docs/validation.md` has all tasks.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass, field
from itertools import chain

from vla_attention.schemas.episode_steps import Displaced
from vla_attention.schemas.errors import listing, plural
from vla_attention.schemas.safe_text import visible
from vla_attention.schemas.stores.store_format import EpisodeAttributes, Protocol

#: The version that is installed: Cosmos Policy's own, and the last one with the floors of 3.2.3, which openpi pins.
PUBLISHED_MUJOCO = "3.3.2"
_DARKER_FLOORS_SINCE, _SETTLES_ELSEWHERE_SINCE = (3, 3, 3), (3, 4)
#: What installs it.
MEND = f"`pip install mujoco=={PUBLISHED_MUJOCO}`"


def is_libero(suite: str) -> bool:
    """Whether a suite's scenes are LIBERO's, by its name: the standard ones, and those of LIBERO-PRO."""
    return suite.startswith("libero_")


def what_differs(version: str) -> str:
    """What a MuJoCo does to LIBERO's scenes, as the rest of a sentence; empty for one that does as the published.

    version: `3.8.1`; anything without a number is not known, and says nothing.
    """
    found = re.match(r"\d+(\.\d+)*", version)
    numbers = tuple(map(int, found[0].split("."))) if found else ()
    if numbers >= _SETTLES_ELSEWHERE_SINCE:
        return "objects come to rest elsewhere than in the published evaluations, and floors are darker"
    if numbers >= _DARKER_FLOORS_SINCE:
        return "floors are darker than in the published evaluations"
    return ""


def simulated_with(protocol: Protocol, episode: EpisodeAttributes) -> str:
    """The MuJoCo that simulated an episode in LIBERO; empty where nobody knows, or where there was none.

    Of a caller's own loop it is that of its process.
    """
    if not is_libero(protocol.suite):
        return ""
    if episode.steps is not None:
        return episode.steps.mujoco
    return episode.provenance.get("mujoco", "") if protocol.name == "recorded" else ""


def describe_departures(lost_relations: Iterable[str], displaced: Iterable[Displaced]) -> list[str]:
    """What is not as in the published evaluations at the beginning, as parts of a sentence; none where all is."""
    said, farthest = [], dict[str, float]()
    if relations := list(dict.fromkeys(lost_relations)):
        said.append(f"the scene did not begin as the task says ({visible(listing(relations, 3))})")
    for one in displaced:
        farthest[one.name] = max(one.distance, farthest.get(one.name, 0.0))
    if farthest:
        moved = [f"{name} by {100 * far:.0f} cm" for name, far in sorted(farthest.items(), key=lambda of: -of[1])]
        said.append(f"objects stood elsewhere than in the published evaluations ({visible(listing(moved, 3))})")
    return said


@dataclass
class SimulatedScenes:
    """Counts, of episodes one after the other, those whose scenes are not those of the published evaluations."""

    num_episodes: int = 0
    _by_version: dict[str, int] = field(default_factory=dict)
    _lost: list[tuple[str, ...]] = field(default_factory=list)
    _displaced: list[tuple[Displaced, ...]] = field(default_factory=list)

    def add(self, protocol: Protocol, episode: EpisodeAttributes) -> None:
        """Count an episode of a run."""
        self.num_episodes += 1
        version = simulated_with(protocol, episode)
        if what_differs(version):
            self._by_version[version] = self._by_version.get(version, 0) + 1
        if episode.steps is not None and episode.steps.lost_relations:
            self._lost.append(episode.steps.lost_relations)
        if episode.steps is not None and episode.steps.displaced:
            self._displaced.append(episode.steps.displaced)

    def describe(self, name: str) -> str:
        """How the scenes of a store differ, with the command that mends it, as a sentence; empty where they do not."""
        every, said = plural(self.num_episodes, "episode"), []
        if self._by_version:
            number = sum(self._by_version.values())
            part = "" if number == self.num_episodes else f" in {number} of {every}"
            versions = listing(sorted(self._by_version))
            differs = max(map(what_differs, self._by_version), key=len)  # the longer one says what the other does
            said.append(f"was simulated with MuJoCo {visible(versions)}{part} (capture again after {MEND}): {differs}")
        for of_episodes, parts in (
            (self._lost, describe_departures(chain.from_iterable(self._lost), ())),
            (self._displaced, describe_departures((), chain.from_iterable(self._displaced))),
        ):
            said += [f"in {len(of_episodes)} of {every} {part}" for part in parts]
        if not said:
            return ""
        return f"{name} {'; '.join(said)}." if self._by_version else f"Of {name}: {'; '.join(said)}."
