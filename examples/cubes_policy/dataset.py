"""Demonstrations for training: reading a folder, keeping scenes out, and drawing batches.

A batch depends on the seed and the number of the step only, so that a training that was killed goes on with the same
batches.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray

from vla_attention.capture.environments.cubes.scene import MARK_VERBS, paste_mark
from vla_attention.capture.environments.cubes.tasks import MARK_INSTRUCTION
from vla_attention.schemas.errors import BadArgument, UserError, listing, unknown_name
from vla_attention.schemas.stores.store_place import refuse_in_store

#: What a policy can learn from. `words`: the instruction alone decides. `redundant`: a mark in the picture says the
#: same. `mark`: the mark alone says it. `no-wrist`: as `words`, with wrist pictures of other samples.
Control = Literal["words", "redundant", "mark", "no-wrist"]
CONTROLS: tuple[Control, ...] = get_args(Control)
#: Part of the scenes that are never trained on.
HELD_OUT = 0.05
INDEX_FILE = "demonstrations.json"

_AGENT, _WRIST = 0, 1


class UnusableDemonstrations(UserError, ValueError):
    """The folder has no demonstrations, or not all of them."""


@dataclass(frozen=True)
class Samples:
    """Samples of demonstrations, one for each picture.

    pictures: (sample, camera, 64, 64, 3) uint8, agent view and wrist, as the model sees them. state: (sample, 8),
    `libero_state`. actions: (sample, 10, 7), the expert's, in -1..1. task, episode, step, scene: (sample,). eef:
    (sample, 3), the gripper's position in metres. cube_positions: (sample, cube, 3) in metres, NaN for a cube that is
    absent. cube_pixels: (sample, camera, cube, 2), row and column of the centres in [0, 1], NaN out of view. target and
    destination: (sample,), index of a cube, -1 for no destination.
    """

    pictures: NDArray[np.uint8]
    state: NDArray[np.float32]
    actions: NDArray[np.float32]
    task: NDArray[np.int16]
    episode: NDArray[np.int32]
    step: NDArray[np.int16]
    eef: NDArray[np.float32]
    cube_positions: NDArray[np.float32]
    cube_pixels: NDArray[np.float32]
    target: NDArray[np.int8]
    destination: NDArray[np.int8]
    scene: NDArray[np.int32]

    def __len__(self) -> int:
        return len(self.task)

    def take(self, chosen: NDArray[np.integer]) -> Samples:
        """Return the chosen samples."""
        return Samples(**{field.name: getattr(self, field.name)[chosen] for field in fields(self)})


@dataclass(frozen=True)
class Demonstrations:
    """Content of a folder. digest: SHA-256 (hex) over its index and the names and sizes of its parts."""

    samples: Samples
    digest: str


#: Shape of one sample of each array; 4 cubes, 2 cameras.
_SHAPES: dict[str, tuple[int, ...]] = {
    "pictures": (2, 64, 64, 3),
    "state": (8,),
    "actions": (10, 7),
    "eef": (3,),
    "cube_positions": (4, 3),
    "cube_pixels": (2, 4, 2),
}


def new_folder(folder: Path, content: str) -> None:
    """Make a folder if there is none; raises `BadArgument`, which says for what it was meant."""
    refuse_in_store(folder, f"make a folder for the {content} at")
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise BadArgument(
            f"Cannot make the folder '{folder}' for the {content} ({error.strerror}); give another one."
        ) from error


def read_demonstrations(folder: str | Path) -> Demonstrations:
    """Read all parts of a folder into memory, about 25 kB a sample.

    Raises `UnusableDemonstrations`, which names the part and the array that does not fit.
    """
    folder = Path(folder)
    index, parts = folder / INDEX_FILE, sorted(folder.glob("part_*.npz"))
    if not index.is_file() or not parts:
        raise UnusableDemonstrations(
            f"'{folder}' has no demonstrations: expected {INDEX_FILE} and part_0000.npz ..., found "
            f"{listing(sorted(p.name for p in folder.iterdir())) if folder.is_dir() else 'no folder'}; make them with "
            "python -m examples.cubes_policy demonstrate FOLDER."
        )
    digest = hashlib.sha256(index.read_bytes())
    read: dict[str, list[np.ndarray]] = {field.name: [] for field in fields(Samples)}
    for part in parts:
        digest.update(f"{part.name} {part.stat().st_size}\n".encode())
        try:
            with np.load(part, allow_pickle=False) as stored:
                arrays = {name: stored[name] for name in read}
        except Exception as error:  # a damaged zip raises almost anything
            raise UnusableDemonstrations(f"'{part}' cannot be read ({error}); make it again.") from error
        for name, array in arrays.items():
            expected = (len(arrays["task"]), *_SHAPES.get(name, ()))
            if array.shape != expected:
                raise UnusableDemonstrations(f"'{name}' of '{part}' has shape {array.shape}; expected {expected}.")
            read[name].append(array)
    return Demonstrations(Samples(**{name: np.concatenate(found) for name, found in read.items()}), digest.hexdigest())


def split_scenes(samples: Samples, seed: int = 0) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the samples for training and those held out, about `HELD_OUT` of the scenes and at least one.

    Whether a scene is held out does not depend on the other scenes, so that more of them can be added later.
    """
    scenes = np.unique(samples.scene)
    if len(scenes) < 2:
        raise BadArgument(
            f"The demonstrations have {len(scenes)} scene; at least 2 are needed, because one is held out."
        )
    lots = np.random.Generator(np.random.Philox(seed)).random(int(scenes[-1]) + 1)
    held_out = lots[samples.scene] < max(HELD_OUT, float(np.nextafter(lots[scenes].min(), 1.0)))
    return np.flatnonzero(~held_out), np.flatnonzero(held_out)


def usable_samples(samples: Samples, control: Control, num_tasks: int) -> NDArray[np.bool_]:
    """Return which samples a training uses: those of the first tasks; a mark does not say on what a cube is put."""
    usable: NDArray[np.bool_] = samples.task < num_tasks
    if control == "mark":
        usable = usable & (samples.destination < 0)
    return usable


def task_weights(task: NDArray[np.integer]) -> NDArray[np.float64]:
    """Return the probability of each sample (sample,).

    A task gets the square root of its share, so that short tasks are not drowned by long ones.
    """
    _, index, counts = np.unique(task, return_inverse=True, return_counts=True)
    weights = counts[index] ** -0.5
    normalised: NDArray[np.float64] = weights / weights.sum()
    return normalised


def seen_instructions(instructions: tuple[str, ...], control: Control) -> tuple[str, ...]:
    """Return what the policy reads for each task under a control."""
    return (MARK_INSTRUCTION,) * len(instructions) if control == "mark" else instructions


def verb_index(instruction: str) -> int:
    """Return the index in `MARK_VERBS` of what an instruction of the suite asks for."""
    words = instruction.split()
    verb = {"put": "put_on", "push": f"push_{words[-1]}"}.get(words[0], words[0]) if words else ""
    if verb not in MARK_VERBS:
        raise unknown_name("verb of the instruction", instruction, MARK_VERBS)
    return MARK_VERBS.index(verb)


def pictures_of(
    samples: Samples,
    chosen: NDArray[np.integer],
    others: NDArray[np.integer],
    instructions: tuple[str, ...],
    control: Control,
) -> NDArray[np.uint8]:
    """Return the pictures (sample, camera, 64, 64, 3) of the chosen samples under a control.

    others: for each chosen sample, another one, whose wrist picture `no-wrist` takes.
    """
    pictures: NDArray[np.uint8] = samples.pictures[chosen]
    if control == "no-wrist":
        pictures[:, _WRIST] = samples.pictures[others, _WRIST]
    if control in ("redundant", "mark"):
        for place, sample in enumerate(chosen):
            verb = verb_index(instructions[samples.task[sample]])
            pictures[place, _AGENT] = paste_mark(pictures[place, _AGENT], int(samples.target[sample]), verb)
    return pictures
