"""Faults that cost one episode: it is dropped and named, tried once more where that can help, and the run goes on.

Everything else ends the run: a full disk, a store that was replaced, a mistake in the arguments.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from vla_attention.capture.engine.observation_checks import CameraBlack
from vla_attention.capture.engine.simulation import SimulationFailed
from vla_attention.capture.recording.finite_numbers import NumbersNotFinite
from vla_attention.capture.store.episode_writer import ReplanRefused
from vla_attention.schemas.errors import UserError, listing
from vla_attention.schemas.stores.store_format import CorruptEpisode, StoreError

#: So many episodes in a row with the same fault, and none recorded between them, end the run: all others would meet it.
MOST_IN_A_ROW = 3
#: Episodes whose fault is told in full at the end; the others are named.
_MOST_TOLD = 3


class SimulatorDied(SimulationFailed):
    """The process of a simulator ended again and again in the same episode."""


class MachineBroken(UserError, RuntimeError):
    """Episode after episode met the same fault."""


class EpisodesMissing(StoreError):
    """A run is over, and episodes that it was asked for are missing, because each attempt ended with a fault."""


#: What may go wrong with one episode while the others are fine. `ReplanRefused`: numbers that cannot be right.
#: `CorruptEpisode`: what was read back from the disk is not what was written.
EPISODE_FAULTS = (SimulationFailed, NumbersNotFinite, ReplanRefused, CorruptEpisode)

#: What to do about a fault that episode after episode meets; of the first class that fits.
_REMEDIES: dict[type[Exception], str] = {
    CameraBlack: "drawing fails on this machine: look at it with vla-attention capture doctor",
    SimulatorDied: "simulators cannot run here: use a smaller --num-envs; see vla-attention capture doctor for memory",
    SimulationFailed: "look at this machine with vla-attention capture doctor",
    Exception: "look at the checkpoint and the disk with vla-attention capture doctor",
}


@dataclass
class Faults:
    """The faults of one run. dropped: episode -> the sentence of its last fault."""

    dropped: dict[str, str] = field(default_factory=dict)
    _tried_again: set[str] = field(default_factory=set, init=False)
    #: In what way episodes failed since the last one that was recorded -> those episodes.
    _in_a_row: dict[str, set[str]] = field(default_factory=dict, init=False)

    def note(self, episode: str, error: Exception) -> bool:
        """Note the fault of an attempt; returns whether the episode shall be tried again.

        Raises:
            MachineBroken: it is the `MOST_IN_A_ROW`th episode in a row that failed in the same way.
        """
        way = getattr(error, "reason", "") or type(error).__name__
        met = self._in_a_row.setdefault(way, set())
        met.add(episode)
        if len(met) >= MOST_IN_A_ROW:
            remedy = next(remedy for kind, remedy in _REMEDIES.items() if isinstance(error, kind))
            raise MachineBroken(
                f"{error} {MOST_IN_A_ROW} episodes in a row met this fault, so that the run ends; {remedy}. If only "
                "some tasks have it, leave them out with --task. All episodes that were recorded are whole; go on with "
                "--resume."
            ) from error
        if can_help_to_repeat(error) and episode not in self._tried_again:
            self._tried_again.add(episode)
            return True
        self.dropped[episode] = str(error)
        return False

    def note_recorded(self) -> None:
        """Note that an episode was recorded: not all meet what failed before."""
        self._in_a_row.clear()

    def raise_missing(self) -> None:
        """Raise `EpisodesMissing` if an episode was dropped."""
        if self.dropped:
            raise EpisodesMissing(describe_missing(self.dropped))


def can_help_to_repeat(error: Exception) -> bool:
    """Whether an episode may succeed when it is tried again after a fault.

    A new simulator may do better, unless one after the other died. The numbers of a policy are the same again, unless
    its call, made again, was finite. What is written to a disk again may come back as it was.
    """
    if isinstance(error, NumbersNotFinite):
        return error.passing
    return isinstance(error, (SimulationFailed, CorruptEpisode)) and not isinstance(error, SimulatorDied)


def describe_missing(dropped: Mapping[str, str]) -> str:
    """Return what is missing after a run, in the words of the first faults. dropped: episode -> sentence."""
    count = len(dropped)
    told = " ".join(list(dropped.values())[:_MOST_TOLD])
    more = f" ({count - _MOST_TOLD} more faults are above.)" if count > _MOST_TOLD else ""
    return (
        f"{count} of the episodes asked for {'is' if count == 1 else 'are'} missing: {listing(dropped, 40)}. {told}"
        f"{more} What was recorded is whole; the same command with --resume tries what is missing again."
    )
