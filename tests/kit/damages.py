"""Random damage to the files of a store, one file at a time and undone again, and what notices it.

A damage follows from the store, the kind of file and a number. `vla-attention store verify` must name the file. An
analysis that reads the file must refuse or give the same numbers: `tried` says which, and `benchmarks/reliability.py`
counts.
"""

from __future__ import annotations

import contextlib
import io
import json
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from random import Random
from typing import Any

import numpy as np
import polars as pl

import vla_attention as va
from tests.kit.site_stores import SiteStoreSpec, write_site_store
from tests.kit.stores import StoreSpec, every_key_seen, small_effects, small_steps, write_store
from vla_attention.analyze.__main__ import main as analyze
from vla_attention.analyze.api import OpenStores
from vla_attention.analyze.core.contributions import group_norms
from vla_attention.schemas.effects import CHANGE, CUT
from vla_attention.schemas.errors import UserError
from vla_attention.schemas.stores.reader import open_store
from vla_attention.schemas.stores.seal import SEAL_FILE

#: Small enough that every analysis takes some hundredths of a second.
SPEC = StoreSpec(
    tasks=(0, 1),
    episodes=2,
    replans=2,
    layers=(0, 2),
    heads=(0, 1),
    contributions=True,
    plant_effects=small_effects,
    plant_steps=small_steps,
)
_EPISODE = re.compile(r"episodes/(?P<episode>task\d+_episode\d+)/(?P<inner>.*)")


@dataclass(frozen=True)
class FileKind:
    """Files of one purpose: a pattern of their paths in the store, and the analyses (`ANALYSES`) that read them."""

    name: str
    pattern: str
    analyses: tuple[str, ...]


_IN_EPISODE = r"episodes/[^/]+/"
#: The first pattern that fits a path is that of its kind.
KINDS: tuple[FileKind, ...] = (
    FileKind("root", r"zarr\.json", ("episodes", "spans")),
    FileKind("group of episodes", r"episodes/zarr\.json", ("episodes", "spans")),
    FileKind("attributes of an episode", _IN_EPISODE + r"zarr\.json", ("episodes", "spans", "words")),
    FileKind("seal", _IN_EPISODE + r"seal/zarr\.json", ("episodes", "spans")),
    FileKind("groups of an episode", _IN_EPISODE + r"[^/]+/zarr\.json", ("spans", "patches")),
    FileKind(
        "metadata of arrays",
        _IN_EPISODE + r".*/zarr\.json",
        ("spans", "patches", "contributions", "objects", "rest"),
    ),
    FileKind("rows", _IN_EPISODE + r"[^/]+/rows/.*", ("patches",)),
    FileKind("masses of segments, and sums", _IN_EPISODE + r"[^/]+/atoms/.*", ("spans",)),
    FileKind("uniform attention", _IN_EPISODE + r"[^/]+/uniform/.*", ("spans",)),
    FileKind("roles of keys", _IN_EPISODE + r"[^/]+/key_role/.*", ("spans", "words")),
    FileKind("contributions", _IN_EPISODE + r"[^/]+/contribution/.*", ("contributions",)),
    FileKind("state and actions", _IN_EPISODE + r"(state|actions|dataset_actions)/.*", ("time", "rest")),
    FileKind("effects", _IN_EPISODE + r"(effects|[^/]+/cut)/.*", ("rest",)),
    FileKind("steps", _IN_EPISODE + r"steps/.*", ("rest",)),
    FileKind("pictures", _IN_EPISODE + r"(camera_)?frames/.*", ("rest",)),
    FileKind("coverage by objects", _IN_EPISODE + r"objects/.*", ("objects",)),
)


def _groups(run: OpenStores, site: str, **groups: str) -> pl.DataFrame:
    return run.analyze(groups={**groups, "others": "*"}, site=site)["steps_groups"]


def _rest(run: OpenStores, site: str) -> dict[str, Any]:
    """What is read of an episode by overlays, effects and deviations only: the same calls, without what they draw."""
    return {
        f"{episode.name}/{name}": episode.read(name)
        for store in run.stores
        for episode in store.episodes
        for name in episode.attributes.arrays
        if name in ("state", "actions", "dataset_actions", CHANGE)
        or name.startswith(("frames/", "camera_frames/", "steps/"))
        or name.endswith(f"/{CUT}")
    }


def _of_groups(run: OpenStores, site: str) -> pl.DataFrame | None:
    """Norms of groups; those of `contributions` are read at the first site that has such keys."""
    norms = group_norms(run.ask(site=site))
    return None if norms is None else norms.norms().collect()


def _camera(run: OpenStores) -> str:
    return next(camera for site in run.attributes.sites for camera in site.cameras)


#: Questions about a site; together they read every file of an episode.
ANALYSES: dict[str, Callable[[OpenStores, str], object]] = {
    "episodes": lambda run, site: (run.episodes, str(run.analyze(list=True))),
    "spans": lambda run, site: (
        run.analyze(site=site)["steps"],
        run.analyze(site=site)["tasks_groups"],
        str(run.analyze(site=site)),
    ),
    "patches": lambda run, site: _groups(run, site, corner=f"patch:{_camera(run)}[0:1,0:1]"),
    "words": lambda run, site: run.words(site=site)["words_episodes"],
    "contributions": lambda run, site: (run.analyze(site=site)["contributions_steps"], _of_groups(run, site)),
    "objects": lambda run, site: _groups(run, site, bowl="object:akita_black_bowl_1"),
    "time": lambda run, site: run.analyze(by=("time",), site=site)["by"],
    "rest": _rest,
}
#: Not for stores of a replayed data set, which have neither objects nor the protocol of a simulator.
_OF_SIMULATORS = ("objects", "time")


@dataclass(frozen=True)
class Subject:
    """A store that is damaged, another of another run with files of the same paths, and the numbers that it gives.

    sites: names of its sites. numbers: by analysis and site.
    """

    path: Path
    other: Path
    sites: tuple[str, ...]
    numbers: Mapping[tuple[str, str], object]

    @classmethod
    def of(cls, path: Path, other: Path) -> Subject:
        """The subject, after its whole store has answered."""
        simulated = "objects/" in "".join(open_store(path).episodes[0].attributes.arrays)
        names = [name for name in ANALYSES if simulated or name not in _OF_SIMULATORS]
        run = va.open(path)
        sites = tuple(site.name for site in run.attributes.sites)
        asked = [(name, site) for name in names for site in sites]
        return cls(path, other, sites, {(name, site): ANALYSES[name](run, site) for name, site in asked})

    def questions_about(self, path: str) -> list[tuple[str, str]]:
        """The analyses that read a file, and the site that they are about: that of the file, or else the first."""
        site = _inner(path).partition("/")[0]
        site = site if site in self.sites else self.sites[0]
        return [(name, site) for name in kind_of(path).analyses if (name, site) in self.numbers]

    def files(self) -> dict[str, list[str]]:
        """Kind to paths of the files of the store; an error for a file of no kind."""
        found: dict[str, list[str]] = {}
        for file in sorted(file for file in self.path.rglob("*") if file.is_file()):
            path = file.relative_to(self.path).as_posix()
            found.setdefault(kind_of(path).name, []).append(path)
        return found


@dataclass(frozen=True)
class Damage:
    """What happened to a file; `also` is the second file of an exchange, which got the first one's bytes."""

    kind: FileKind
    path: str
    what: str
    content: bytes | None
    also: str = ""


@dataclass(frozen=True)
class Noticed:
    """What came of a damage.

    Attributes:
        verify: what `vla-attention store verify` printed, and its exit code.
        named: whether it found a fault and named the file.
        analyses: by name: "refused", "same", "different", or the error that is no sentence.
    """

    damage: Damage
    verify: str
    exit_code: int
    named: bool
    analyses: Mapping[str, str]

    @property
    def problems(self) -> list[str]:
        """What must never happen; empty if all is well."""
        about = f"{self.damage.what}: {self.damage.path}"
        found = [] if self.named else [f"{about}: verify ended with {self.exit_code} and printed {self.verify!r}"]
        wrong = {name: result for name, result in self.analyses.items() if result not in ("refused", "same")}
        return found + [f"{about}: {name} gave {result}" for name, result in wrong.items()]


def make_subjects(folder: Path) -> dict[str, Subject]:
    """A store whose queries see masked keys too, and one of a replayed data set with two sites."""
    subjects = {}
    for name, other in (("joint", 0), ("other", 1)):
        write_store(folder / f"{name}.zarr", spec=SPEC, seed=other, plant_uniform=every_key_seen)
        replayed = SiteStoreSpec(episodes=2, replans=2, dataset_actions=0.5, protocol="dataset", seed=other)
        write_site_store(folder / f"{name}-sites.zarr", replayed)
    for name in ("", "-sites"):
        subjects[f"joint{name}"] = Subject.of(folder / f"joint{name}.zarr", folder / f"other{name}.zarr")
    return subjects


def kind_of(path: str) -> FileKind:
    """The kind of a file, by its path in the store."""
    return next(kind for kind in KINDS if re.fullmatch(kind.pattern, path))


def draw(subject: Subject, kind: str, number: int) -> Damage:
    """The damage of that number to a file of a kind.

    It changes something: drawn again are exchanges of equal files, and JSON documents that say the same in other bytes
    (white space at the end), of those that no seal lists.
    """
    random = Random(f"{kind} {number}")
    paths = subject.files()[kind]
    while True:
        path = random.choice(paths)
        before = (subject.path / path).read_bytes()
        damage = _drawn(random, subject, paths, path, before)
        if damage is not None and damage.content != before and not _says_the_same(path, damage.content, before):
            return damage


def _says_the_same(path: str, content: bytes | None, before: bytes) -> bool:
    """Whether a document that no seal lists holds the same JSON; what a seal lists is compared byte by byte."""
    if content is None or not (path in ("zarr.json", "index.json", "episodes/zarr.json") or path.endswith(SEAL_FILE)):
        return False
    try:
        return bool(json.loads(content) == json.loads(before))
    except (ValueError, RecursionError):
        return False


def _drawn(random: Random, subject: Subject, paths: Sequence[str], path: str, before: bytes) -> Damage | None:
    kind, what = kind_of(path), random.choice(ACTIONS)
    if what == "bit flipped":
        place = random.randrange(8 * len(before))
        changed = bytearray(before)
        changed[place // 8] ^= 1 << place % 8
        return Damage(kind, path, f"{what} at byte {place // 8}", bytes(changed))
    if what == "cut off":
        length = random.randrange(len(before))
        return Damage(kind, path, f"{what} after {length} of {len(before)} bytes", before[:length])
    if what == "deleted":
        return Damage(kind, path, what, None)
    if what == "appended to":
        return Damage(kind, path, what, before + random.choice([random.randbytes(random.randint(1, 64)), b"\n", b"\0"]))
    if what == "exchanged between stores":
        return Damage(kind, path, what, (subject.other / path).read_bytes())
    others = [one for one in (paths if what == "exchanged between episodes" else _beside(subject, path)) if one != path]
    inner, episode = (_inner(path), _episode(path)) if _EPISODE.fullmatch(path) else ("", "")
    if what == "exchanged between episodes":
        others = [one for one in others if _inner(one) == inner and _episode(one) != episode]
    if not others:
        return None
    also = random.choice(others)
    return Damage(kind, path, f"{what} with {also}", (subject.path / also).read_bytes(), also)


#: What happens to a file.
ACTIONS = (
    "bit flipped",
    "cut off",
    "deleted",
    "appended to",
    "exchanged within the episode",
    "exchanged between episodes",
    "exchanged between stores",
)


def _beside(subject: Subject, path: str) -> list[str]:
    """The files of the same episode, or of no episode."""
    every = [one for paths in subject.files().values() for one in paths]
    return [one for one in every if _episode(one) == _episode(path)]


def _episode(path: str) -> str:
    match = _EPISODE.fullmatch(path)
    return match["episode"] if match else ""


def _inner(path: str) -> str:
    """The path inside of the episode."""
    match = _EPISODE.fullmatch(path)
    return match["inner"] if match else path


@contextmanager
def damaged(subject: Subject, damage: Damage) -> Iterator[None]:
    """Damage the store within the block."""
    before = {path: (subject.path / path).read_bytes() for path in (damage.path, damage.also) if path}
    try:
        if damage.content is None:
            (subject.path / damage.path).unlink()
        else:
            (subject.path / damage.path).write_bytes(damage.content)
        if damage.also:
            (subject.path / damage.also).write_bytes(before[damage.path])
        yield
    finally:
        for path, content in before.items():
            (subject.path / path).write_bytes(content)


def tried(subject: Subject, damage: Damage) -> Noticed:
    """Damage the store, verify it, and ask the analyses that read the file."""
    with damaged(subject, damage):
        exit_code, printed = verified(subject.path)
        answers = {name: _answer(subject, name, site) for name, site in subject.questions_about(damage.path)}
    return Noticed(damage, printed, exit_code, exit_code != 0 and names_file(printed, subject, damage), answers)


def verified(store: Path) -> tuple[int, str]:
    """Exit code and text of `vla-attention store verify`."""
    text = io.StringIO()
    with contextlib.redirect_stdout(text), contextlib.redirect_stderr(text):
        code = analyze(["store", "verify", str(store)])
    return code, text.getvalue()


def names_file(printed: str, subject: Subject, damage: Damage) -> bool:
    """Whether what `verify` printed has a line with the damaged file: its path, or its episode and the path there.

    An exchange has two damaged files, of which one is enough. A seal is called that. For a file of no episode the
    store's path is enough, if the store cannot be opened.
    """
    lines = printed.splitlines()
    for path in filter(None, (damage.path, damage.also)):
        episode, inner = _episode(path), _inner(path).replace(SEAL_FILE, "its seal")
        if any(path in line or (episode and episode in line and inner in line) for line in lines):
            return True
        if not episode and len(lines) == 1 and str(subject.path) in printed:
            return True
    return False


def _answer(subject: Subject, name: str, site: str) -> str:
    try:
        found = ANALYSES[name](va.open(subject.path), site)
    except UserError:
        return "refused"
    except Exception as error:
        return f"{type(error).__name__}: {error}"
    return "same" if same(found, subject.numbers[name, site]) else "different"


def same(one: object, other: object) -> bool:
    """Whether two answers are equal to the bit; NaN equals NaN."""
    if isinstance(one, tuple) and isinstance(other, tuple):
        return len(one) == len(other) and all(same(a, b) for a, b in zip(one, other, strict=True))
    if isinstance(one, dict) and isinstance(other, dict):
        return one.keys() == other.keys() and all(same(one[name], other[name]) for name in one)
    if isinstance(one, pl.DataFrame) and isinstance(other, pl.DataFrame):
        return one.schema == other.schema and one.equals(other, null_equal=True)
    if isinstance(one, np.ndarray) and isinstance(other, np.ndarray):
        return one.dtype == other.dtype and one.shape == other.shape and one.tobytes() == other.tobytes()
    return type(one) is type(other) and one == other
