"""Find results files, and read ours and those of the published scripts into the same tables.

Our files follow `vla_attention.schemas.results` strictly. Files of the published scripts may differ from that in these
points, and in no other:

    Infinity and NaN as ratios                       they become infinite and undefined, as null does in our files
    a ratio of 0 where no ratio exists               undefined: both masses 0, or "layers_avg" of layers without a
                                                     finite ratio
    no "layers_avg", no action fields, no summary    as they are; see `ResultsFile`
    no numbers of keys, no total mass                unknown
    unknown fields                                   skipped, and named in `ResultsFile.unused`
    one episode that is not in a list                a list of one
"""

from __future__ import annotations

import glob
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, get_args

import polars as pl
from msgspec.structs import fields

from vla_attention.analyze.measures.tables import LAYERS_AVG
from vla_attention.schemas.errors import listing, shortened
from vla_attention.schemas.foreign_files import read_regular
from vla_attention.schemas.jsonable import decode_json
from vla_attention.schemas.results import (
    RESULTS_PREFIX,
    EpisodeResult,
    NumStepsDefinition,
    ResultsError,
    ResultsNotFound,
    StepRatio,
    suite_of_results_file,
)
from vla_attention.schemas.safe_text import visible

_LAYER = re.compile(r"layer_([0-9]{1,6})")
#: Whole numbers are at most this: tasks, episodes and steps are counted.
_MOST_COUNTED = 10**12
#: Bytes of a results file; a thousand episodes of the published scripts take 100 MB.
_MOST_BYTES = 2_000_000_000
#: The published scripts treat a mass of up to this as zero, and write a ratio of 0 where both masses are zero.
NO_MASS = 1e-8
RATIO = "visual_linguistic_ratio"
#: The fields of the Cosmos scripts that name the latent frames of the queries, the visual and the text side.
FRAME_FIELDS = ("query_frame", "visual_frame", "text_frame")
#: Fields that only files of ours have, and their columns.
_COUNTS = {"total_mass": "total_mass", "num_visual_tokens": "visual_keys", "num_text_tokens": "linguistic_keys"}
#: The largest accepted fraction: fractions are quotients of sums in float32.
_ONE = 1 + 1e-4
_EPISODE_FIELDS = [field.name for field in fields(EpisodeResult)]
_NEEDED = [field.name for field in fields(EpisodeResult) if field.required and field.name != "summary"]
_STEP_FIELDS = [field.name for field in fields(StepRatio)]
_TYPES = {
    "success": pl.Boolean, "num_steps": pl.Int64, "ratio": pl.Float64,
    **dict.fromkeys(("visual_fraction", "linguistic_fraction", *_COUNTS.values()), pl.Float64),
}  # fmt: skip
_STATED = {"episode": pl.Int64, "layer": pl.String, "measure": pl.String, "statistic": pl.String, "value": pl.Float64}


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
class ResultsFile:
    """One results file.

    Attributes:
        path: its path.
        suite: its suite, from the file name.
        kind: the definition of its masses.
        episodes: one row per episode, in the file's order: episode (position), task_id, instruction, episode_index,
            success (null where it is not known), num_steps (the loop's counter, `results.loop_counter`), num_replans (0
            for an episode without steps).
        steps: one row per (episode, replan, layer): episode (position), replan, env_step, layer (the number as a
            string, or "layers_avg"), layer_number, ratio (infinite; null where undefined), visual_mass,
            linguistic_mass, visual_fraction, linguistic_fraction (null where undefined), total_mass, visual_keys,
            linguistic_keys (null where the file has none) and, with `kind.has_action`, action_mass and action_fraction.
        summaries: the numbers of the file's own summaries: episode (position), layer, measure, statistic, value.
        zeros: how many ratios of 0 stand for "no ratio" and were read as undefined.
        unused: names of unknown fields, which were skipped.
    """

    path: Path
    suite: str
    kind: ResultsKind
    episodes: pl.DataFrame
    steps: pl.DataFrame
    summaries: pl.DataFrame
    zeros: int
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
        content = read_regular(path, _MOST_BYTES)
    except OSError as error:
        raise ResultsNotFound(f"Cannot read results file {path}: {error.strerror or error}.") from None
    try:
        document = decode_json(content)
    except ValueError as error:
        raise ResultsError(f"{path} is not a results file: not valid JSON ({error}).") from None
    try:
        return _file(path, document)
    except _Problem as problem:
        raise ResultsError(f"{path}: {problem}") from None


class _Problem(ValueError):
    """A fault in a results file; the message does not name the file."""


def _file(path: Path, document: Any) -> ResultsFile:
    if isinstance(document, dict) and "per_step_ratios" in document:
        document = [document]
    if not isinstance(document, list):
        raise _Problem(f"it is not a results file: expected a list of episodes, found {_kind_of(document)}.")
    if not document:
        raise _Problem("it holds no episode: there is nothing to summarise.")
    episodes = [_episode(number, given) for number, given in enumerate(document)]
    names = [f"episode {row['episode']} (task {row['task_id']}, episode {row['episode_index']})" for row in episodes]
    kinds: dict[ResultsKind, str] = {}
    both = list(zip(document, names, strict=True))
    rows = [row for number, (given, where) in enumerate(both) for row in _steps(number, given, where, kinds)]
    stated = [row for number, (given, where) in enumerate(both) for row in _summary(number, given, where)]
    if not rows:
        raise _Problem(f"none of its {len(episodes)} episodes has a single step: there is nothing to summarise.")
    seen: dict[str, int] = {}
    for number, name in enumerate(one.partition(" (")[2] for one in names):
        if name in seen:
            raise _Problem(f"episodes {seen[name]} and {number} are both {name[:-1]}.")
        seen[name] = number
    steps, zeros = _with_undefined(_frame(rows))
    of_steps = steps.group_by("episode").agg(num_replans=pl.col("env_step").n_unique().cast(pl.Int64))
    table = _frame(episodes).join(of_steps, on="episode", how="left", maintain_order="left")
    unknown = [name for given in document for name in given if name not in _EPISODE_FIELDS]
    each = (step for given in document for layer in given["per_step_ratios"].values() for step in layer)
    unknown += [name for step in each for name in step if name not in _STEP_FIELDS]
    return ResultsFile(
        path=path,
        suite=suite_of_results_file(path),
        kind=next(iter(kinds)),
        episodes=table.with_columns(pl.col("num_replans").fill_null(0)),
        steps=steps,
        summaries=pl.DataFrame(stated, schema=_STATED),
        zeros=zeros,
        unused=tuple(dict.fromkeys(unknown)),
    )


def _frame(rows: list[dict[str, Any]]) -> pl.DataFrame:
    types = {name: kind for name, kind in _TYPES.items() if name in rows[0]}
    return pl.DataFrame(rows, schema_overrides=types, infer_schema_length=None)


def _episode(number: int, given: object) -> dict[str, Any]:
    """What identifies an episode, checked."""
    where = f"episode {number}"
    episode = _expect(given, dict, where)
    missing = [name for name in _NEEDED if name not in episode]
    if missing:
        what = "it is not a results file: " if number == 0 and len(missing) > 3 else ""
        raise _Problem(f"{what}{where} lacks {listing(map(repr, missing))}.")
    stated = episode.get("num_steps_definition")
    if stated not in (None, *get_args(NumStepsDefinition)):
        known = listing(map(repr, get_args(NumStepsDefinition)))
        raise _Problem(f"{where}, num_steps_definition is {shortened(repr(stated))}; expected {known}, or nothing.")
    return {
        "episode": number,
        "task_id": _whole(episode["task_id"], f"{where}, task_id"),
        "instruction": visible(_expect(episode["task_description"], str, f"{where}, task_description")),
        "episode_index": _whole(episode["episode_idx"], f"{where}, episode_idx"),
        # Null where a run did not know the outcome.
        "success": None if episode["success"] is None else _expect(episode["success"], bool, f"{where}, success"),
        "num_steps": _whole(episode["num_steps"], f"{where}, num_steps"),
    }


def _steps(
    number: int, episode: Mapping[str, Any], where: str, kinds: dict[ResultsKind, str]
) -> Iterator[dict[str, Any]]:
    """The steps of an episode, checked; `kinds` takes the definition of their masses, which has to be one."""
    grouping, denoise = episode.get("grouping"), episode.get("denoise_steps")
    if grouping is not None:
        texts = (grouping, episode.get("grouping_description") or "")
        grouping = tuple(_expect(text, str, f"{where}, grouping") for text in texts)
    if denoise is not None:
        given = _expect(denoise, list, f"{where}, denoise_steps")
        denoise = tuple(_whole(step, f"{where}, denoise_steps") for step in given)
    for name, steps in _expect(episode["per_step_ratios"], dict, f"{where}, per_step_ratios").items():
        layer, before = _layer_of(name, f"{where}, per_step_ratios"), -1
        for position, step in enumerate(_expect(steps, list, f"{where}, per_step_ratios.{name}")):
            at = f"{where}, {name}[{position}]"
            row, frames = _step(_expect(step, dict, at), at)
            kind = ResultsKind(frames, "action_mass" in row, grouping, denoise)
            if kind not in kinds and kinds:
                other, first = next(iter(kinds.items()))
                raise _Problem(f"{at} holds masses of another kind ({kind}) than {first} ({other}).")
            kinds.setdefault(kind, at)
            if row["env_step"] <= before:
                raise _Problem(f"{at}.step is {row['env_step']}, after {before}: steps must rise.")
            before = row["env_step"]
            if step[RATIO] is None and layer != LAYERS_AVG and row["visual_mass"] > NO_MASS >= row["linguistic_mass"]:
                # Our files write null for infinite and for undefined ratios; the masses tell which it is.
                row["ratio"] = math.inf
            yield {"episode": number, "layer": layer, **row}


def _step(step: Mapping[str, Any], at: str) -> tuple[dict[str, Any], tuple[str, str, str] | None]:
    """A row of a step, and the names of its latent frames."""
    sides = ("visual", "linguistic", *(["action"] if "action_mass" in step else []))
    has_frames = any(step.get(name) is not None for name in FRAME_FIELDS)
    needed = ["step", RATIO, *(f"{side}_{kind}" for side in sides for kind in ("mass", "fraction"))]
    missing = [name for name in (*needed, *(FRAME_FIELDS if has_frames else ())) if name not in step]
    if missing:
        raise _Problem(f"{at} lacks {listing(map(repr, missing))}.")
    row: dict[str, Any] = {"env_step": _whole(step["step"], f"{at}.step")}
    row["ratio"] = _number(step[RATIO], f"{at}.{RATIO}", math.inf)
    for side in sides:
        mass = row[f"{side}_mass"] = _number(step[f"{side}_mass"], f"{at}.{side}_mass", math.inf)
        if mass is None or math.isinf(mass):
            raise _Problem(f"{at}.{side}_mass is {shortened(repr(step[f'{side}_mass']))}; expected a finite mass.")
        row[f"{side}_fraction"] = _number(step[f"{side}_fraction"], f"{at}.{side}_fraction", _ONE)
    for name, column in _COUNTS.items():
        row[column] = _number(step.get(name), f"{at}.{name}", math.inf)
    if not has_frames:
        return row, None
    query, visual, text = (_expect(step[name], str, f"{at}.{name}") for name in FRAME_FIELDS)
    return row, (query, visual, text)


def _with_undefined(steps: pl.DataFrame) -> tuple[pl.DataFrame, int]:
    """Steps with replan and layer_number, and null for a ratio of 0 that stands for none; how many those were."""
    average, zero = pl.col("layer") == LAYERS_AVG, pl.col("ratio") == 0
    nothing = ~average & zero & (pl.max_horizontal("visual_mass", "linguistic_mass") <= NO_MASS)
    steps = steps.with_columns(
        nothing.fill_null(False).alias("none"),
        pl.col("layer").cast(pl.Int64, strict=False).alias("layer_number"),
        (pl.col("env_step").rank("dense").over("episode").cast(pl.Int64) - 1).alias("replan"),
    )
    finite = ~average & pl.col("ratio").is_finite() & ~pl.col("none")
    measured, known = ((one.fill_null(False)).any().over("episode", "replan") for one in (~average, finite))
    steps = steps.with_columns(none=pl.col("none") | (average & zero & measured & ~known).fill_null(False))
    return steps.with_columns(ratio=pl.when(~pl.col("none")).then("ratio")).drop("none"), int(steps["none"].sum())


def _summary(number: int, episode: Mapping[str, Any], where: str) -> Iterator[dict[str, Any]]:
    """The numbers that an episode states of its steps."""
    for name, given in _expect(episode.get("summary", {}), dict, f"{where}, summary").items():
        layer = _layer_of(name, f"{where}, summary")
        for measure, statistics in _expect(given, dict, f"{where}, summary.{name}").items():
            if measure != "num_steps":
                at = f"{where}, summary.{name}.{measure}"
                for statistic, value in _expect(statistics, dict, at).items():
                    stated = _number(value, f"{at}.{statistic}", math.inf)
                    one = {"episode": number, "layer": layer, "measure": measure, "statistic": statistic}
                    yield {**one, "value": stated}


def _layer_of(name: str, where: str) -> str:
    match = _LAYER.fullmatch(name)
    if match is None and name != LAYERS_AVG:
        raise _Problem(f"{where} has '{visible(shortened(name))}'; expected layer_N or {LAYERS_AVG}.")
    return match[1] if match else LAYERS_AVG


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
    if not 0 <= value <= most:
        raise _Problem(f"{where} is {value}; expected a number from 0{'' if math.isinf(most) else ' to 1'}.")
    return float(value)


_NAMES: dict[type, str] = {dict: "an object", list: "a list", str: "a text", bool: "true or false"}


def _kind_of(value: object) -> str:
    for kind, name in _NAMES.items():
        if isinstance(value, kind):
            return name if kind is not bool else repr(value).lower()
    return "null" if value is None else f"the number {value}"
