"""Faults that cost one episode: it is dropped and named, tried once more where that can help, and the run goes on.

Everything else ends the run: a full disk, a store that was replaced, a mistake in the arguments.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from vla_attention.capture.recording.finite_numbers import NumbersNotFinite
from vla_attention.capture.rollout.observation_checks import CameraBlack
from vla_attention.capture.rollout.simulation import SimulationFailed
from vla_attention.capture.store.episode_writer import ReplanRefused
from vla_attention.schemas.errors import UserError, listing
from vla_attention.schemas.stores.store_format import CorruptEpisode, StoreError

#: So many faults of one kind in a row, with no episode recorded between them, end the run: the machine is broken.
MOST_IN_A_ROW = 3
#: Episodes whose fault is told in full at the end; the others are named.
_MOST_TOLD = 3


class SimulatorDied(SimulationFailed):
    """The process of a simulator ended again and again in the same episode."""


class MachineBroken(UserError, RuntimeError):
    """The same fault came again and again, and would come in every episode."""


class EpisodesMissing(StoreError):
    """A run is over, and episodes that it was asked for are missing, because each attempt ended with a fault."""


#: What may go wrong with one episode while the others are fine. `ReplanRefused`: numbers that cannot be right.
#: `CorruptEpisode`: what was read back from the disk is not what was written.
EPISODE_FAULTS = (SimulationFailed, NumbersNotFinite, ReplanRefused, CorruptEpisode)

#: Faults that the machine makes, not the episode, if they come in a row, and what to do then.
_OF_THE_MACHINE: dict[type[Exception], str] = {
    CameraBlack: "drawing fails on this machine: look at it with vla-attention capture doctor",
    SimulatorDied: "simulators cannot run here: use a smaller --num-envs; see vla-attention capture doctor for memory",
}


@dataclass
class Faults:
    """The faults of one run. dropped: episode -> the sentence of its last fault."""

    dropped: dict[str, str] = field(default_factory=dict)
    _tried_again: set[str] = field(default_factory=set, init=False)
    _in_a_row: dict[type[Exception], int] = field(default_factory=dict, init=False)

    def note(self, episode: str, error: Exception) -> bool:
        """Note the fault of an attempt; returns whether the episode shall be tried again.

        Raises:
            MachineBroken: the fault came `MOST_IN_A_ROW` times in a row, and is one of the machine.
        """
        for kind, remedy in _OF_THE_MACHINE.items():
            if isinstance(error, kind):
                self._in_a_row[kind] = self._in_a_row.get(kind, 0) + 1
                if self._in_a_row[kind] >= MOST_IN_A_ROW:
                    raise MachineBroken(
                        f"{error} This was the {MOST_IN_A_ROW}rd time in a row, so that the run ends; {remedy}. All "
                        "episodes that were recorded are whole; go on with --resume."
                    ) from error
        if can_help_to_repeat(error) and episode not in self._tried_again:
            self._tried_again.add(episode)
            return True
        self.dropped[episode] = str(error)
        return False

    def note_recorded(self) -> None:
        """Note that an episode was recorded: what failed before was no fault of the machine."""
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
