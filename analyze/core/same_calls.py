"""Whether a rerun and its base are of the same policy calls: what each was given, but for what the condition changes.

A base that was recorded again with the same settings has the digest of the one that was rerun. So the digest of the run
is not enough: everything that both stores hold of a call is compared before two replans are a pair.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vla_attention.schemas.safe_text import visible
from vla_attention.schemas.stores.episode_shapes import misfits
from vla_attention.schemas.stores.reader import Store, StoredEpisode
from vla_attention.schemas.stores.store_format import CorruptEpisode, StoreError

#: (replan,) in which replans something differs.
_Differs = NDArray[np.bool_]
_PICTURES = ("frames", "camera_frames")


@dataclass(frozen=True)
class Changed:
    """What a condition changes in the inputs of its base: this may differ, and nothing else.

    What the base's own run had changed is in what its calls were given; a rerun of it has the same.
    """

    prompt: bool
    noise: bool
    cameras: frozenset[str]

    @classmethod
    def between(cls, base: Store, rerun: Store) -> Changed:
        """What the rerun changes beyond its base."""
        mine, theirs = base.attributes.interventions, rerun.attributes.interventions
        cameras = frozenset(change.camera for change in theirs.images if change not in mine.images)
        return cls(theirs.prompt != mine.prompt, theirs.noise != mine.noise, cameras)

    def is_free(self, name: str) -> bool:
        """Whether an array or a list of numbers of that name may differ."""
        group, _, camera = name.partition("/")
        return (name == "noise_seed" and self.noise) or (group in _PICTURES and camera in self.cameras)


def check_same_calls(base: Store, episode: StoredEpisode, rerun: Store, own: StoredEpisode) -> None:
    """Raise `StoreError` unless an episode of a rerun is of the policy calls of its base's episode.

    Compared are number and place of the replans, task, instruction, noise seed, prompt, state and pictures, as far as
    both stores hold them (`held_by_one` says what is not), and the base's actions with those that the rerun says that
    its base had. Pictures are compared by the sha256 of their values in the attributes, which the seal binds.

    Args:
        base, episode: the base and its episode.
        rerun, own: the rerun and its episode.

    Raises:
        CorruptEpisode: the rerun's episode does not fit its run.
    """
    for problem in misfits(rerun.attributes, own.attributes):
        raise CorruptEpisode(f"Episode {own.name} of {rerun.path} is damaged: {problem}.")
    mine, theirs, where = episode.attributes, own.attributes, f"{episode.name} of {rerun.path}"
    shapes = [part.arrays["actions"].shape if "actions" in part.arrays else () for part in (mine, theirs)]
    if mine.num_replans != theirs.num_replans or shapes[0] != shapes[1]:
        raise StoreError(
            f"{where} has {theirs.num_replans} replans and actions of the shape {shapes[1]}, and in its base "
            f"{mine.num_replans} and {shapes[0]}: these are not the same replans; make the rerun again."
        )
    if (mine.task_name, mine.instruction) != (theirs.task_name, theirs.instruction):
        raise StoreError(
            f"{where} is of the task '{theirs.task_name}' ('{visible(theirs.instruction)}'), and in its base "
            f"{base.path} of '{mine.task_name}' ('{visible(mine.instruction)}'): these are not the same episodes; make "
            "the rerun again."
        )
    differing = dict(_differing_inputs(episode, own, Changed.between(base, rerun)))
    if differing:
        replan = min(int(np.argmax(differs)) for differs in differing.values())
        what = [name for name, differs in differing.items() if differs[replan]]
        raise StoreError(
            f"Replan {replan} of {where} was given {' and '.join(what)} than in its base {base.path}, which the "
            "condition does not change: the base was recorded again since, or the rerun is of another one; make the "
            "rerun again."
        )
    if own.has("base_actions") and (differs := _array_differs(episode, "actions", own, "base_actions")) is not None:
        raise StoreError(
            f"Replan {int(np.argmax(differs))} of {episode.name} has other actions in {base.path} than in the base of "
            f"which {rerun.path} was made: the base was recorded again since; make the rerun again."
        )


def held_by_one(bases: Sequence[Store], reruns: Sequence[Store]) -> list[str]:
    """The inputs that only one of a run and its rerun holds, and which are therefore not compared."""
    known = {(store.suite, episode.name): (store, episode) for store in bases for episode in store.episodes}
    pairs = [(known.get((store.suite, one.name)), (store, one)) for store in reruns for one in store.episodes]
    found = [name for base, own in pairs if base is not None for name in _held_by_one(*base, *own)]
    return list(dict.fromkeys(found))


def _held_by_one(base: Store, episode: StoredEpisode, rerun: Store, own: StoredEpisode) -> list[str]:
    free, names = Changed.between(base, rerun), {*_inputs(episode), *_inputs(own)}
    return [
        _called(name, "s") for name in sorted(names) if episode.has(name) != own.has(name) and not free.is_free(name)
    ]


def _inputs(episode: StoredEpisode) -> list[str]:
    """Arrays of what an episode's calls were given, and `noise_seed`, where it is known."""
    pictures = [name for name in episode.attributes.arrays if name.partition("/")[0] in _PICTURES]
    return [name for name in ("noise_seed", "state") if episode.has(name)] + pictures


def _differing_inputs(base: StoredEpisode, own: StoredEpisode, free: Changed) -> Iterator[tuple[str, _Differs]]:
    """What of the calls' inputs differs although nothing changed it, and in which replans."""
    mine, theirs = base.attributes, own.attributes
    known: dict[str, tuple[Sequence[object], Sequence[object]]] = {"environment step": (mine.env_step, theirs.env_step)}
    if mine.noise_seed and theirs.noise_seed and not free.noise:
        known["noise seed"] = (mine.noise_seed, theirs.noise_seed)
    if not free.prompt:
        known["prompt"] = (_prompts(base), _prompts(own))
    for name, (first, other) in known.items():
        differs = np.array([one != two for one, two in zip(first, other, strict=True)], dtype=bool)
        if differs.any():
            yield f"another {name}", differs
    for name in _inputs(base):
        if name == "noise_seed" or not own.has(name) or free.is_free(name):
            continue
        of_array = _array_differs(base, name, own, name)
        if of_array is not None:
            yield f"another {_called(name)}", of_array


def _prompts(episode: StoredEpisode) -> list[str]:
    """The text of each replan's prompt."""
    attributes = episode.attributes
    return [attributes.prompts[index].text for index in attributes.prompt_index]


def _called(name: str, plural: str = "") -> str:
    """What an input is called in a sentence."""
    group, _, camera = name.partition("/")
    if group in _PICTURES:
        return f"picture{plural} of camera '{camera}'"
    return {"state": f"state{plural} of the robot", "noise_seed": f"noise seed{plural}"}[name]


def _array_differs(first: StoredEpisode, name: str, other: StoredEpisode, others: str) -> _Differs | None:
    """In which replans (replan,) two arrays differ; None where they are the same. Equal ones are not read."""
    if first.attributes.arrays[name] == other.attributes.arrays[others]:
        return None
    one, two = first.read(name), other.read(others)
    if one.shape != two.shape:
        return np.ones(len(one), dtype=bool)
    differs: _Differs = (one != two).reshape(len(one), -1).any(axis=1)
    return differs if differs.any() else None
