"""LIBERO-PRO: the suites of LIBERO with another sentence, object, place or task. Its files come with this package.

`libero_pro.tar.xz` (made by scripts/make_libero_pro.py) holds, for each of its 16 suites under LIBERO-PRO's own name,
ten task files and the stored initial states of each: data of LIBERO-PRO, CC BY 4.0 (CREDIT.txt in it). Meshes of its
own objects are in the wheels of LIBERO's assets.

LIBERO-PRO keeps the names of the base suite's tasks. Where it has another sentence or task, the policy is told what the
task file says; else the task's name is evaluated, as in LIBERO, and the task file's sentence is only stored.
"""

from __future__ import annotations

import atexit
import functools
import io
import lzma
import re
import tarfile
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vla_attention.capture.environments.base import Suite, Task, TaskTexts
from vla_attention.capture.environments.libero_assets import LiberoAssetsMissing
from vla_attention.capture.environments.task_families import sentence_template
from vla_attention.schemas.errors import UserError, listing
from vla_attention.schemas.install_line import install_line

_ARCHIVE = Path(__file__).with_name("libero_pro.tar.xz")
_PREFIX = "libero_pro_"
#: Those whose sentence is the task file's.
_TOLD_OTHERWISE = ("lan", "task")
#: LIBERO-PRO's object -> the object of LIBERO that it is like, in all but its file of the same name.
_OBJECTS = {
    "bigger_akita_black_bowl": "akita_black_bowl",
    "black_bowl": "akita_black_bowl",
    "bigger_alphabet_soup": "alphabet_soup",
    "blue_ketchup": "alphabet_soup",  # it stands as the soup does
    "green_bbq_sauce": "bbq_sauce",
    "green_butter": "butter",
    "green_chocolate_pudding": "chocolate_pudding",
    "red_cream_cheese": "cream_cheese",
    "red_salad_dressing": "salad_dressing",
    "yellow_milk": "alphabet_soup",
    "yellow_tomato_sauce": "tomato_sauce",
    "red_basket": "basket",
    "yellow_plate": "plate",
    "brown_rack": "wine_rack",
    "white_bottle": "wine_bottle",
    "yellow_moka_pot": "moka_pot",
    "yellow_cabinet": "wooden_cabinet",
    "yellow_stove": "flat_stove",
}


class UnusableLiberoPro(UserError, ValueError):
    """The files of LIBERO-PRO that come with this package are damaged."""


def own_name(suite: str) -> str | None:
    """LIBERO-PRO's own name of a suite; None for a suite that is not LIBERO-PRO's."""
    return suite.replace(_PREFIX, "libero_") if suite.startswith(_PREFIX) else None


@functools.cache
def _files(archive: Path) -> dict[str, bytes]:
    """The content of every file in the archive by its name; 6 MB."""
    try:
        with tarfile.open(archive, "r:xz") as tar:
            return {entry.name: file.read() for entry in tar if (file := tar.extractfile(entry)) is not None}
    except (tarfile.TarError, lzma.LZMAError, EOFError, OSError) as error:
        raise UnusableLiberoPro(_again(f"'{archive}' cannot be read ({error})")) from error


def _read(suite: str, file: str) -> bytes:
    try:
        return _files(_ARCHIVE)[f"libero_pro/{own_name(suite)}/{file}"]
    except KeyError:
        raise UnusableLiberoPro(_again(f"'{_ARCHIVE}' lacks '{file}' of {suite}")) from None


def _again(problem: str) -> str:
    return f"{problem}; LIBERO-PRO's files come with vla-attention: install it again."


def pro_texts(suite: Suite, name: str, evaluated: str) -> tuple[TaskTexts, str]:
    """Return a task's texts, and what its file says; evaluated: the sentence that LIBERO makes of its name.

    Of another sentence for the same task, the family is that of the task.
    """
    content = _read(suite.name, f"{name}.bddl").decode("utf-8", "replace")
    found = re.search(r"\(:language\s([^()]+)\)", content)
    if found is None:
        raise UnusableLiberoPro(_again(f"The task file of '{name}' in {suite.name} has no sentence"))
    written = " ".join(found[1].lower().split())  # as LIBERO's parser reads it
    kind = suite.name.rpartition("_")[2]
    told = written if kind in _TOLD_OTHERWISE else evaluated
    return (name, told, sentence_template(told if kind == "task" else evaluated)), written


@functools.cache
def _folder(suite: str) -> Path:
    """A folder with the suite's task files, removed at exit: LIBERO reads them from a disk."""
    folder = tempfile.TemporaryDirectory(prefix="vla-libero-pro-")
    atexit.register(folder.cleanup)
    within = f"libero_pro/{own_name(suite)}/"
    for name, content in _files(_ARCHIVE).items():
        if name.startswith(within) and name.endswith(".bddl"):
            Path(folder.name, name.removeprefix(within)).write_bytes(content)
    return Path(folder.name)


def pro_task_file(task: Task) -> Path:
    """Return the path of a task's file."""
    return _folder(task.suite) / f"{task.name}.bddl"


def pro_initial_states(task: Task) -> NDArray[np.float64]:
    """Read a task's stored initial states; an array of objects, which would execute code, is refused."""
    content = io.BytesIO(_read(task.suite, f"{task.name}.npy"))
    try:
        return np.lib.format.read_array(content, allow_pickle=False).astype(np.float64, casting="safe")
    except (ValueError, TypeError, EOFError) as error:
        raise UnusableLiberoPro(
            _again(f"The initial states of '{task.name}' in {task.suite} are no numbers ({error})")
        ) from error


def check_pro_assets(suite: str, assets: Path) -> Path:
    """Return the assets; `LiberoAssetsMissing` where they lack objects of LIBERO-PRO, in a suite that has them."""
    if own_name(suite) is None or not suite.endswith("_object"):
        return assets
    there = {path.stem for path in assets.glob("*/*")}
    if absent := [name for name in _OBJECTS if name not in there]:
        raise LiberoAssetsMissing(
            f"The assets in '{assets}' lack {listing(absent, 3)}, objects of LIBERO-PRO in {suite}. The wheels have "
            f"them: {install_line('libero-assets')}; then leave out --libero-assets."
        )
    return assets


@functools.cache
def register_objects() -> None:
    """Make LIBERO know LIBERO-PRO's objects; LIBERO must have been loaded."""
    from libero.libero.envs.base_object import OBJECTS_DICT, VISUAL_CHANGE_OBJECTS_DICT

    for name, like in _OBJECTS.items():
        made = _class_like(OBJECTS_DICT[like], name)
        OBJECTS_DICT[name] = made
        if like in VISUAL_CHANGE_OBJECTS_DICT:
            VISUAL_CHANGE_OBJECTS_DICT[name] = made


def _class_like(base: Any, obj_name: str) -> Any:
    def __init__(self: Any, name: str = obj_name, obj_name: str = obj_name, **more: Any) -> None:
        base.__init__(self, name, obj_name, **more)

    return type(obj_name.title().replace("_", ""), (base,), {"__init__": __init__})
