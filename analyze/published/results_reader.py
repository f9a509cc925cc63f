"""Find results files, and read ours and those of the published scripts into the same tables.

Our files follow `vla_attention.schemas.results` strictly. Files of the published scripts may differ from that in these
points, and in no other:

    Infinity and NaN as ratios                       they become infinite and undefined, as null does in our files
    a ratio of 0 where no ratio exists               undefined: both masses 0, or "layers_avg" of layers without a
                                                     finite ratio
    no "layers_avg", no action fields, no summary    as they are; see `ResultsFile`
    no numbers of keys, no total mass                unknown; ours from before lack them, too
    no "num_steps_definition"                        the loop's counter in their files; in ours from before the number
                                                     of executed actions, from which the counter is computed
    unknown fields                                   skipped, and named in `ResultsFile.unused`
    one episode that is not in a list                a list of one
"""

from __future__ import annotations

import glob
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import MISSING, dataclass, fields, replace
from pathlib import Path
from typing import Any, get_args

import polars as pl

from vla_attention.analyze.measures.frames import LAYERS_AVG
from vla_attention.schemas.documents import decode_json
from vla_attention.schemas.errors import listing, shortened
from vla_attention.schemas.limits import RESULTS_BYTES, RESULTS_NESTS
from vla_attention.schemas.regular_files import read_regular
from vla_attention.schemas.results import (
    RESULTS_PREFIX,
    EpisodeResult,
    NumStepsDefinition,
    ResultsError,
    ResultsNotFound,
    StepRatio,
    loop_counter,
    suite_of_results_file,
)
from vla_attention.schemas.safe_text import visible

_LAYER = re.compile(r"layer_([0-9]{1,6})")
#: Whole numbers are at most this: tasks, episodes and steps are counted.
_MOST_COUNTED = 10**12
#: Masses and ratios are at most this, unless they are infinite.
_MOST_MEASURED = 1e300
#: The published scripts treat a mass of up to this as zero, and write a ratio of 0 where both masses are zero.
NO_MASS = 1e-8
#: The fields of the Cosmos scripts that name the latent frames of the queries, the visual and the text side.
FRAME_FIELDS = ("query_frame", "visual_frame", "text_frame")
_MASSES = ("visual_mass", "linguistic_mass")
_FRACTIONS = ("visual_fraction", "linguistic_fraction")
#: Fields that only newer files of ours have, and their columns.
_COUNTS = {"total_mass": "total_mass", "num_visual_tokens": "visual_keys", "num_text_tokens": "linguistic_keys"}
#: The largest accepted fraction: fractions are quotients of sums in float32.
_ONE = 1 + 1e-4


@dataclass(frozen=True)
class ResultsKind:
    """The definition of a file's masses, as far as the file states it. Files of different kinds are not pooled.

    Attributes:
        frames: the latent frames of the queries, the visual and the text side (Cosmos scripts); None in other files.
        has_action: the file has an action mass, which is part of the sum in every fraction.
        grouping: name and description of the grouping that visual and linguistic are from; None where the file does
            not say.
        denoise_steps: the denoise steps that masses are means over; None where the file does not say.
    """

    frames: tuple[str, str, str] | None
    has_action: bool
    grouping: tuple[str, str] | None = None
    denoise_steps: tuple[int, ...] | None = None

    def __str__(self) -> str:
        steps = "" if self.denoise_steps is None else f"; denoise steps {listing(self.denoise_steps, 40)}"
        if self.frames is not None:
            query, visual, text = self.frames
            return f"latent frames, {visual} over {text}, queries {query}{steps}"
        whose = "as the file's writer defined them" if self.grouping is None else f"grouping '{self.grouping[0]}'"
        return f"visual over linguistic keys, {whose}{'' if self.has_action else '; no action mass'}{steps}"


@dataclass(frozen=True)
class SummaryNumber:
    """A number in a file's own summary, with its episode (position in the file), layer, measure and statistic."""

    episode: int
    layer: str
    measure: str
    statistic: str
    value: float | None


@dataclass(frozen=True)
class ResultsFile:
    """One results file.

    Attributes:
        path: its path.
        suite: its suite, from the file name.
        kind: the definition of its masses.
        episodes: one row per episode, in the file's order: episode (position), task_id, instruction, episode_index,
            success (null where it is not known), num_steps (the loop's counter, `results.loop_counter`; null where it
            cannot be known), num_replans (0 for an episode without steps).
        steps: one row per (episode, replan, layer): episode (position), replan, env_step, layer (the number as a
            string, or "layers_avg"), layer_number, ratio (infinite; null where undefined), visual_mass,
            linguistic_mass, visual_fraction, linguistic_fraction (null where undefined), total_mass, visual_keys,
            linguistic_keys (null where the file has none) and, with `kind.has_action`, action_mass and action_fraction.
        summary_numbers: the numbers of the file's own summaries.
        zeros: how many ratios of 0 stand for "no ratio" and were read as undefined.
        counts_actions: `num_steps` of the file is the number of executed actions, as in our files from before.
        unused: names of unknown fields, which were skipped.
    """

    path: Path
    suite: str
    kind: ResultsKind
    episodes: pl.DataFrame
    steps: pl.DataFrame
    summary_numbers: tuple[SummaryNumber, ...]
    zeros: int
    counts_actions: bool
    unused: tuple[str, ...]


def find_results(given: Sequence[str]) -> list[Path]:
    """Files that `--results` names: files, folders (their results files, or else every .json), or patterns for either.

    Raises:
        ResultsNotFound: one of the arguments matches no file.
    """
    try:
        return _found(given)
    except OSError as error:
        if isinstance(error, ResultsNotFound):
            raise
        raise ResultsNotFound(
            f"Cannot look for results files in {listing(given, 3)}: {error.strerror or error}."
        ) from None


def _found(given: Sequence[str]) -> list[Path]:
    by_real_path: dict[Path, Path] = {}
    for text in given:
        path = Path(text).expanduser()
        matches = [path] if path.exists() else [Path(match) for match in sorted(glob.glob(str(path), recursive=True))]
        files = []
        for match in matches:
            inside = sorted(match.glob(f"{RESULTS_PREFIX}*.json")) or sorted(match.glob("*.json"))
            files += inside if match.is_dir() else [match]
        if not files:
            raise ResultsNotFound(_nothing_found(text, path, matches))
        for file in files:
            by_real_path.setdefault(file.resolve(), file)
    return list(by_real_path.values())


def _nothing_found(text: str, path: Path, matches: Sequence[Path]) -> str:
    folder = matches[0] if matches else path.parent
    while not folder.is_dir():
        folder = folder.parent
    near = sorted(folder.glob("*.json")) + sorted(folder.glob(f"*/{RESULTS_PREFIX}*.json"))
    shown = f"near it, in {folder}: {listing([file.relative_to(folder) for file in near], 3)}"
    if matches:
        return f"There is no results file in {text}; expected {RESULTS_PREFIX}SUITE.json (or another .json); {shown}."
    return f"Nothing matches --results {text}; expected a results file, a folder of them, or a pattern; {shown}."


def read_results_file(path: Path) -> ResultsFile:
    """Read one results file, ours or of the published scripts.

    Raises:
        ResultsNotFound: it cannot be opened.
        ResultsError: it is no results file, or a field is wrong; names the file, the episode and the field.
    """
    try:
        content = read_regular(path, RESULTS_BYTES)
    except OSError as error:
        raise ResultsNotFound(f"Cannot read results file {path}: {error.strerror or error}.") from None
    try:
        document = decode_json(content, RESULTS_BYTES, RESULTS_NESTS)
    except ValueError as error:
        raise ResultsError(f"{path} is not a results file: not valid JSON ({error}).") from None
    try:
        return _Reading(path).read(document)
    except _Problem as problem:
        raise ResultsError(f"{path}: {problem}") from None


class _Problem(ValueError):
    """A fault in a results file; the message does not name the file."""


class _Reading:
    """One pass over a document: collects rows, numbers of summaries, kinds of masses and unknown fields."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.rows: list[dict[str, Any]] = []
        self.summary_numbers: list[SummaryNumber] = []
        self.unused: dict[str, None] = {}
        self.kinds: dict[ResultsKind, str] = {}
        self.zeros = 0
        self.ours = False

    def read(self, document: object) -> ResultsFile:
        """The whole file."""
        if isinstance(document, dict) and "per_step_ratios" in document:
            document = [document]
        if not isinstance(document, list):
            raise _Problem(f"it is not a results file: expected a list of episodes, found {_kind_of(document)}.")
        if not document:
            raise _Problem("it holds no episode: there is nothing to summarise.")
        episodes = [self._episode(number, given) for number, given in enumerate(document)]
        if not self.rows:
            raise _Problem(f"none of its {len(episodes)} episodes has a single step: there is nothing to summarise.")
        seen: dict[tuple[int, int], int] = {}
        for episode in episodes:
            identity = (episode["task_id"], episode["episode_index"])
            if identity in seen:
                raise _Problem(f"episodes {seen[identity]} and {episode['episode']} are both {_of(*identity)}.")
            seen[identity] = episode["episode"]
        counts_actions = self._counts_actions(document)
        for episode in episodes:
            first = episode.pop("first_step")
            if counts_actions:
                given = (episode["num_steps"], episode["success"])
                episode["num_steps"] = None if first is None or given[1] is None else loop_counter(first, *given)
        kind = next(iter(self.kinds))
        floats = ("ratio", "visual_fraction", "linguistic_fraction", *_COUNTS.values())
        schema = dict.fromkeys(floats, pl.Float64)
        return ResultsFile(
            path=self.path,
            suite=suite_of_results_file(self.path),
            kind=kind,
            episodes=pl.DataFrame(
                episodes, schema_overrides={"num_steps": pl.Int64, "success": pl.Boolean}, infer_schema_length=None
            ),
            steps=pl.DataFrame(
                self.rows, schema_overrides={**schema, "layer_number": pl.Int64}, infer_schema_length=None
            ),
            summary_numbers=tuple(self.summary_numbers),
            zeros=self.zeros,
            counts_actions=counts_actions,
            unused=tuple(self.unused),
        )

    def _episode(self, number: int, given: object) -> dict[str, Any]:
        where = f"episode {number}"
        episode = _expect(given, dict, where)
        names = [field.name for field in fields(EpisodeResult)]
        needed = [field.name for field in fields(EpisodeResult) if field.default is MISSING and field.name != "summary"]
        missing = [name for name in needed if name not in episode]
        if missing:
            what = "it is not a results file: " if number == 0 and len(missing) > 3 else ""
            raise _Problem(f"{what}{where} lacks {listing(map(repr, missing))}.")
        self._note_unused(episode, names)
        identity: dict[str, Any] = {
            "episode": number,
            "task_id": _whole(episode["task_id"], f"{where}, task_id"),
            "instruction": visible(_expect(episode["task_description"], str, f"{where}, task_description")),
            "episode_index": _whole(episode["episode_idx"], f"{where}, episode_idx"),
            # Null where a run did not know the outcome.
            "success": None if episode["success"] is None else _expect(episode["success"], bool, f"{where}, success"),
            "num_steps": _whole(episode["num_steps"], f"{where}, num_steps"),
        }
        where = f"{where} ({_of(identity['task_id'], identity['episode_index'])})"
        about = self._about(episode, where)
        layers = _expect(episode["per_step_ratios"], dict, f"{where}, per_step_ratios")
        steps = self._steps(number, layers, about, where)
        self._read_summary(number, _expect(episode.get("summary", {}), dict, f"{where}, summary"), where)
        replans = {row["env_step"] for row in steps}
        return {**identity, "num_replans": len(replans), "first_step": min(replans, default=None)}

    def _about(self, episode: Mapping[str, Any], where: str) -> ResultsKind:
        """The definitions that an episode states; the steps add the rest."""
        stated = episode.get("num_steps_definition")
        if stated not in (None, *get_args(NumStepsDefinition)):
            known = listing(map(repr, get_args(NumStepsDefinition)))
            raise _Problem(f"{where}, num_steps_definition is {shortened(repr(stated))}; expected {known}, or nothing.")
        grouping, steps = None, None
        if episode.get("grouping") is not None:
            texts = (episode["grouping"], episode.get("grouping_description") or "")
            grouping = tuple(_expect(text, str, f"{where}, grouping") for text in texts)
        if episode.get("denoise_steps") is not None:
            given = _expect(episode["denoise_steps"], list, f"{where}, denoise_steps")
            steps = tuple(_whole(step, f"{where}, denoise_steps") for step in given)
        return ResultsKind(None, False, grouping, steps)

    def _counts_actions(self, document: Sequence[Mapping[str, Any]]) -> bool:
        """Whether `num_steps` is the number of actions: in our files from before the field that says what it is.

        Ours differ from the published scripts' in that every summary counts the ratios that are not finite.
        """
        return self.ours and all(episode.get("num_steps_definition") is None for episode in document)

    def _steps(self, number: int, layers: Mapping[str, object], about: ResultsKind, where: str) -> list[dict[str, Any]]:
        rows: list[dict[str, Any]] = []
        for name, given in layers.items():
            label, layer_number = _layer_of(name, f"{where}, per_step_ratios")
            before = -1
            for position, step in enumerate(_expect(given, list, f"{where}, per_step_ratios.{name}")):
                at = f"{where}, {name}[{position}]"
                row = self._step(_expect(step, dict, at), about, at)
                if step["visual_linguistic_ratio"] is None and label != LAYERS_AVG:
                    # Our files write null for infinite and for undefined ratios; the masses tell which it is.
                    row["ratio"] = math.inf if row["visual_mass"] > NO_MASS >= row["linguistic_mass"] else None
                if row["env_step"] <= before:
                    raise _Problem(f"{at}.step is {row['env_step']}, after {before}: steps must rise.")
                before = row["env_step"]
                rows.append({"episode": number, "layer": label, "layer_number": layer_number, **row})
        replans = {step: i for i, step in enumerate(sorted({row["env_step"] for row in rows}))}
        single = [row for row in rows if row["layer"] != LAYERS_AVG]
        for row in single:
            row["replan"] = replans[row["env_step"]]
            if row["ratio"] == 0 and max(row["visual_mass"], row["linguistic_mass"]) <= NO_MASS:
                row["ratio"] = None
                self.zeros += 1
        measured = {row["env_step"] for row in single}
        finite = {row["env_step"] for row in single if _is_finite(row["ratio"])}
        for row in rows:
            if row["layer"] == LAYERS_AVG:
                row["replan"] = replans[row["env_step"]]
                if row["ratio"] == 0 and row["env_step"] in measured - finite:
                    row["ratio"] = None
                    self.zeros += 1
        self.rows += rows
        return rows

    def _step(self, step: Mapping[str, Any], about: ResultsKind, where: str) -> dict[str, Any]:
        has_action = "action_mass" in step
        masses, fractions = [*_MASSES], [*_FRACTIONS]
        if has_action:
            masses, fractions = [*masses, "action_mass"], [*fractions, "action_fraction"]
        has_frames = any(step.get(name) is not None for name in FRAME_FIELDS)
        required = ["step", "visual_linguistic_ratio", *masses, *fractions, *(FRAME_FIELDS if has_frames else ())]
        missing = [name for name in required if name not in step]
        if missing:
            raise _Problem(f"{where} lacks {listing(map(repr, missing))}.")
        self._note_unused(step, [*(field.name for field in fields(StepRatio)), *FRAME_FIELDS, "selected_call_S"])
        self._note_kind(step, replace(about, has_action=has_action), has_frames, where)
        row: dict[str, Any] = {"env_step": _whole(step["step"], f"{where}.step")}
        for name in masses:
            row[name] = _number(step[name], f"{where}.{name}", math.inf)
            if not _is_finite(row[name]):
                raise _Problem(f"{where}.{name} is {shortened(repr(step[name]))}; expected a finite mass.")
        for name in fractions:
            row[name] = _number(step[name], f"{where}.{name}", _ONE)
        for name, column in _COUNTS.items():
            row[column] = _number(step.get(name), f"{where}.{name}", math.inf)
        row["ratio"] = _number(step["visual_linguistic_ratio"], f"{where}.visual_linguistic_ratio", math.inf)
        return row

    def _note_kind(self, step: Mapping[str, Any], kind: ResultsKind, has_frames: bool, where: str) -> None:
        if has_frames:
            query, visual, text = (_expect(step[name], str, f"{where}.{name}") for name in FRAME_FIELDS)
            kind = replace(kind, frames=(query, visual, text))
        if self.kinds and kind not in self.kinds:
            other, first = next(iter(self.kinds.items()))
            raise _Problem(f"{where} holds masses of another kind ({kind}) than {first} ({other}).")
        self.kinds.setdefault(kind, where)

    def _read_summary(self, number: int, summary: Mapping[str, object], where: str) -> None:
        for name, given in summary.items():
            label, _ = _layer_of(name, f"{where}, summary")
            for measure, statistics in _expect(given, dict, f"{where}, summary.{name}").items():
                if measure == "num_steps":
                    continue
                at = f"{where}, summary.{name}.{measure}"
                for statistic, value in _expect(statistics, dict, at).items():
                    if statistic == "num_nonfinite":
                        self.ours = True
                    else:
                        stated = _number(value, f"{at}.{statistic}", math.inf)
                        self.summary_numbers.append(SummaryNumber(number, label, measure, statistic, stated))

    def _note_unused(self, given: Mapping[str, object], known: Sequence[str]) -> None:
        for name in given:
            if name not in known:
                self.unused.setdefault(name)


def _layer_of(name: str, where: str) -> tuple[str, int | None]:
    if name == LAYERS_AVG:
        return LAYERS_AVG, None
    match = _LAYER.fullmatch(name)
    if match is None:
        raise _Problem(f"{where} has '{visible(shortened(name))}'; expected layer_N or {LAYERS_AVG}.")
    return match[1], int(match[1])


def _expect(value: Any, kind: type, where: str) -> Any:
    if not isinstance(value, kind):
        raise _Problem(f"{where} is {_kind_of(value)}; expected {_NAMES[kind]}.")
    return value


def _whole(value: Any, where: str) -> int:
    if isinstance(value, bool) or not isinstance(value, int) or value < 0:
        raise _Problem(f"{where} is {_kind_of(value)}; expected a whole number from 0.")
    if value > _MOST_COUNTED:
        raise _Problem(f"{where} is a whole number above {_MOST_COUNTED:,}; expected a smaller one.")
    return value


def _number(value: Any, where: str, most: float) -> float | None:
    """A number from 0 to `most`; None for null and NaN."""
    if value is None or (isinstance(value, float) and math.isnan(value)):
        return None
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise _Problem(f"{where} is {_kind_of(value)}; expected a number.")
    if isinstance(value, int) and abs(value) > _MOST_MEASURED:
        raise _Problem(f"{where} is a whole number of more than 300 digits; expected a smaller one.")
    if not 0 <= value <= most:
        raise _Problem(f"{where} is {value}; expected a number from 0{'' if math.isinf(most) else ' to 1'}.")
    return float(value)


def _is_finite(value: float | None) -> bool:
    return value is not None and math.isfinite(value)


def _of(task_id: int, episode_index: int) -> str:
    return f"task {task_id}, episode {episode_index}"


_NAMES: dict[type, str] = {dict: "an object", list: "a list", str: "a text", bool: "true or false"}


def _kind_of(value: object) -> str:
    for kind, name in _NAMES.items():
        if isinstance(value, kind):
            return name if kind is not bool else repr(value).lower()
    return "null" if value is None else f"the number {value}"
