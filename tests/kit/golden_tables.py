"""The golden tables: what every question gives on fixed stores, and what the published lines pass on.

`tests/golden/tables/CASE/TABLE.parquet` holds a table of a command's results; `python -m tests.golden.make_tables` made
them. A command of another form gives the same numbers in tables of another form: `FORMS` says how a kept table is found
among them, and the kept tables stay as they are.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import shlex
import shutil
import subprocess
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import polars as pl
import pytest

from tests.kit.archives import unpacked
from tests.kit.golden_stores import differences
from tests.kit.paths import GOLDEN, ROOT
from vla_attention.__main__ import main as vla_attention
from vla_attention.analyze.published.parse_results import build_parser as parser_of_results
from vla_attention.analyze.published.parse_results import main as parse_attention_ratio_results
from vla_attention.analyze.render.style import Style
from vla_attention.capture.commands.arguments import build_evaluate_parser, build_parser
from vla_attention.capture.policies.families import policy_families
from vla_attention.capture.published.evaluate import arguments_from_environment

FOLDER = GOLDEN / "tables"
PUBLISHED_LINES = [
    shlex.split(line) for line in (GOLDEN / "published_lines.txt").read_text(encoding="utf-8").splitlines()
]
#: Name below which a question sees a store -> its archive. cubes, one_colour: earlier recordings of the example
#: stores, without effects. effects: pi05_cubes with recorded effects of words and cameras, for all four readers.
#: libero, cosmos, replay: policies of test size.
STORES = {
    "one_colour": FOLDER / "stores" / "cubes_one_colour.tar.xz",
    **{name: FOLDER / "stores" / f"{name}.tar.xz" for name in ("cubes", "effects", "libero", "cosmos", "replay")},
}
RERUNS = FOLDER / "stores" / "cubes_reruns"

_STEPS = ("--group", "thing=word:cube", "--group", "seen=role:image", "--ratio", "seen/thing")
_HEADS = (("--by", "layer,head"), ("--by", "denoise"), ("--without-sinks",))
#: Case -> what is asked, the words after `vla-attention` of each question.
CASES: dict[str, tuple[tuple[str, ...], ...]] = {
    "cubes_analyze": (("analyze", "cubes.zarr"),),
    "cubes_cameras": (("analyze", "cubes.zarr", "--grouping", "cameras", "--layers", "0", "2"),),
    "cubes_own_groups": (("analyze", "cubes.zarr", *_STEPS),),
    "cubes_words": (("words", "cubes.zarr"),),
    "cubes_objects": (("objects", "cubes.zarr"),),
    "cubes_heads": tuple(("analyze", "cubes.zarr", *more) for more in _HEADS),
    "cubes_time": (("analyze", "cubes.zarr", "--by", "time"),),
    "cubes_groups": (("analyze", "cubes.zarr", "--list"),),
    "cubes_export": (("analyze", "cubes.zarr"), ("analyze", "cubes.zarr", "--by", "replan")),
    "cubes_per_head": (("analyze", "cubes.zarr", "--by", "head", "--task", "0"),),
    "pair_compare": (("compare", "cubes.zarr", "one_colour.zarr"),),
    "reruns_compare": (("compare", "cubes.zarr", "RERUNS"),),
    "noise_compare": (("compare", "cubes.zarr", "RERUN"),),
    "effects_effects": (("effects", "effects.zarr"), ("effects", "effects.zarr", "--by", "task")),
    "effects_analyze": (("analyze", "effects.zarr"),),
    "effects_words": (("words", "effects.zarr"),),
    "libero_analyze": (("analyze", "libero.zarr"),),
    "libero_reference": (("analyze", "libero.zarr", "--grouping", "reference"),),
    "libero_words": (("words", "libero.zarr"),),
    "libero_objects": (("objects", "libero.zarr"),),
    "libero_heads": tuple(("analyze", "libero.zarr", *more) for more in _HEADS),
    "libero_time": (("analyze", "libero.zarr", "--by", "time"),),
    "libero_groups": (("analyze", "libero.zarr", "--list"),),
    "cosmos_analyze": (("analyze", "cosmos.zarr"),),
    "cosmos_cross": (("analyze", "cosmos.zarr", "--site", "cross"),),
    "cosmos_heads": tuple(("analyze", "cosmos.zarr", *more) for more in _HEADS),
    "cosmos_groups": (("analyze", "cosmos.zarr", "--list"),),
    "replay_deviation": (("effects", "replay.zarr"),),
    "published_results": (("parse", "cubes.zarr"),),
    "published_comparison": (("parse", "cubes.zarr", "libero.zarr"),),
}
#: Variables of the batch scripts, which one at a time and together say everything that can be said.
VARIABLES: dict[str, dict[str, dict[str, str]]] = {
    "evaluate-attention-ratio": {
        "none": {},
        "all": {
            "CHECKPOINT": "PATH", "CONFIG_NAME": "pi05_libero", "TASK_SUITE": "libero_goal", "TASK_ID": "0 3",
            "NUM_EPISODES": "10", "PROTOCOL": "openpi", "SEED": "3", "REPLAN_STEPS": "4", "LAYERS": "17 25 26 27",
            "SAVE_VIZ": "1", "OUTPUT_DIR": "results/mine", "STORE": "mine.zarr", "STAGE": "capture", "DEVICE": "cpu",
            "MAX_REQUEUES": "2", "ARGS": "--max-steps 100 --precision exact",
        },
        "another name of the checkpoint": {"CKPT_PATH": "PATH", "TASK_SUITE": "all", "SAVE_VIZ": "0"},
        "a task of an array": {"SLURM_JOB_ID": "7", "SLURM_ARRAY_TASK_ID": "4", "CHECKPOINT": "PATH"},
        "the analysis of an array": {"SLURM_JOB_ID": "7", "STAGE": "analyze"},
    },
    "evaluate-attention-ratio-cosmos": {
        "none": {},
        "all": {
            "CKPT_PATH": "PATH", "CONFIG_NAME": "NAME", "QUERY_FRAME": "curr_last", "VISUAL_FRAME": "frame1",
            "TEXT_FRAME": "frame0", "LAYERS": "25 26 27", "SEED": "1", "TASK_ID": "2",
        },
    },
}  # fmt: skip


def link_stores(folder: Path) -> None:
    """Give the stores the short names that the questions use: results name a store as it was typed."""
    for name, archive in STORES.items():
        (folder / f"{name}.zarr").symlink_to(unpacked(archive), target_is_directory=True)
    for archive in sorted(RERUNS.glob("*.tar.xz")):
        rerun = unpacked(archive)
        (folder / f"rerun_{rerun.name}").symlink_to(rerun, target_is_directory=True)


def tables_of(case: str, folder: Path) -> dict[str, pl.DataFrame]:
    """Ask the questions of a case in a folder with the stores, and read all tables of their results.

    Plotted data (CSV) and results files (JSON: a row for each value) are tables too. Those of the second question of a
    case are named 1/NAME, and so on.
    """
    tables: dict[str, pl.DataFrame] = {}
    for number, given in enumerate(CASES[case]):
        found = _tables_of(given, folder)
        tables |= found if number == 0 else {f"{number}/{name}": table for name, table in found.items()}
    return tables


def _tables_of(given: tuple[str, ...], folder: Path) -> dict[str, pl.DataFrame]:
    reruns = sorted(path.name for path in folder.glob("rerun_*.zarr"))
    words = [word for one in given for word in {"RERUNS": reruns, "RERUN": reruns[:1]}.get(one, [one])]
    if words[0] != "parse":
        return _asked(vla_attention, [*words, "--output", "results"], folder)
    files = []
    for store in words[1:]:
        _asked(vla_attention, ["analyze", store, "--output", "results"], folder)
        (written,) = folder.glob("results/attention_ratio_results_*.json")
        files.append(str(written.rename(folder / written.name)))
    plots = "--plot-all" if len(files) == 1 else "--plot-comparison"
    return _asked(parse_attention_ratio_results, ["--results", *files, plots, "--output-dir", "results"], folder)


def _asked(program: Callable[[list[str]], int], words: list[str], folder: Path) -> dict[str, pl.DataFrame]:
    shutil.rmtree(folder / "results", ignore_errors=True)
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        patch.setattr(Style, "content", lambda *_: b"")
        assert program(words) == 0
    return dict(_read(folder / "results"))


def _read(folder: Path) -> Iterator[tuple[str, pl.DataFrame]]:
    for file in sorted(folder.rglob("*")):
        if file.suffix == ".parquet":
            yield file.stem, pl.read_parquet(file)
        elif file.suffix == ".csv" and not file.with_suffix(".parquet").exists():
            yield f"{file.stem}_plotted", pl.read_csv(file, infer_schema_length=None)
        elif file.suffix == ".json" and file.name != "result.json":
            values = dict(_values(json.loads(file.read_text(encoding="utf-8"))))
            kept = [(name, value) for name, value in values.items() if not name.startswith(("provenance", "software"))]
            yield f"{file.stem}_values", pl.DataFrame(kept, schema={"name": str, "value": str}, orient="row")


def _values(document: object, name: str = "") -> Iterator[tuple[str, str]]:
    if isinstance(document, dict | list):
        members = document.items() if isinstance(document, dict) else enumerate(document)
        for key, member in members:
            yield from _values(member, f"{name}.{key}" if name else str(key))
    else:
        yield name, json.dumps(document)


def published_arguments() -> pl.DataFrame:
    """A row for each option that a published line, or the variables of a batch script, set: given, option, value."""
    rows = []
    for words in PUBLISHED_LINES:
        if words[0] != "parse-attention-ratio-results":
            rows += [(" ".join(words), *value) for value in _options(parsed(words))]
    for program, settings in VARIABLES.items():
        for name, variables in settings.items():
            words = arguments_from_environment(variables, _family(program))
            options = _options(parsed([program, *words]))
            rows += [(f"{program} with variables: {name}", *value) for value in options]
    return pl.DataFrame(rows, schema={"given": str, "option": str, "value": str}, orient="row")


def _family(program: str) -> Any:
    (family,) = (one for one in policy_families() if one.published and one.published.program == program)
    return family


def parsed(words: list[str]) -> argparse.Namespace:
    """The arguments of a published line; of `make`, those of the capture that it starts."""
    program, *given = words
    if program == "parse-attention-ratio-results":
        return parser_of_results().parse_args(given)
    if program != "make":
        family = _family(program)
        return build_evaluate_parser(family, family.published).parse_args(given)
    # A make that runs the tests hands its own variables, ARGS for instance, to what it starts.
    outside = {"PATH": os.environ["PATH"]}
    made = subprocess.run(
        ["make", "--dry-run", *given], cwd=ROOT, env=outside, capture_output=True, text=True, check=True, timeout=60
    )
    printed = made.stdout.replace("\\\n", " ").splitlines()
    (line,) = [line for line in printed if "vla-capture" in line and "--task-suite" in line]
    _, *given = shlex.split(line)
    return build_parser(given).parse_args(given)


def _options(arguments: argparse.Namespace) -> Iterator[tuple[str, str]]:
    for name, value in sorted(vars(arguments).items()):
        if not callable(value) and name != "family" and value not in (None, False, []):
            yield name, str(value)


_EPISODE = ("suite", "task_id", "episode_index")


@dataclass(frozen=True)
class Form:
    """How a kept table is found in today's results.

    Attributes:
        keys: the columns by which rows are matched.
        rows: today's rows, in the kept columns, from all tables of the results.
        gone: kept columns that are given no more.
        still: the kept rows that are still given; all unless it is given.
        absolute: difference that is allowed whatever the size of a number.
    """

    keys: tuple[str, ...]
    rows: Callable[[Mapping[str, pl.DataFrame]], pl.DataFrame]
    gone: tuple[str, ...] = ()
    still: pl.Expr | None = None
    absolute: float = 1e-8

    def differences(self, tables: Mapping[str, pl.DataFrame], kept: pl.DataFrame) -> list[str]:
        """Where today's rows differ from the kept ones."""
        floats = [pl.col(name).round(9) for name in self.keys if kept.schema[name].is_float()]
        kept = kept if self.still is None else kept.filter(self.still)
        kept = kept.drop(self.gone, strict=False).with_columns(floats)
        rows = (
            self.rows(tables)
            .select(kept.columns)
            .with_columns(floats)
            .join(kept, on=self.keys, how="semi", nulls_equal=True)
        )
        found, expected = (table.sort(self.keys, nulls_last=True) for table in (rows, kept))
        return differences(found, expected, partial(alike, absolute=self.absolute))


def _renamed(table: pl.DataFrame, **names: str) -> pl.DataFrame:
    """The table with further columns, each named after the kept one: kept=today's."""
    return table.with_columns(pl.col(today).alias(kept) for kept, today in names.items())


_SCALE = {
    "first token": "bos", "fixed words of the prompt": "template", "other text": "text", "state digits": "state",
    "image patches": "image",
}  # fmt: skip
_WORDS_GONE = ("density", "density_low", "density_high", "density_episodes", "mass_episodes", "lift_episodes",
               "share_episodes")  # fmt: skip


def _sided(table: pl.DataFrame, of: str) -> pl.DataFrame:
    """A ratio with its interval as log2."""
    return table.with_columns(pl.col(f"{of}{end}").log(2.0).alias(f"log2_{of}{end}") for end in ("", "_low", "_high"))


def _heads(tables: Mapping[str, pl.DataFrame]) -> pl.DataFrame:
    by = tables["by"].drop("layer").rename({"layer_number": "layer"})
    named = by.rename({name: name.replace("ratio_lift", "lift") for name in by.columns if "ratio_lift" in name})
    return _sided(_sided(named, "ratio"), "lift")


def _time_course(tables: Mapping[str, pl.DataFrame]) -> pl.DataFrame:
    columns = {"phase": "position", "": "value", "_low": "low", "_high": "high"}
    parts = []
    if "by" in tables:
        of_ratio = tables["by"].select(
            pl.lit("ratio").alias("quantity"), pl.col("phase").alias("position"), "num_episodes", "num_tasks",
            *(pl.col(f"ratio{end}").alias(columns[end]) for end in ("", "_low", "_high")),
            uniform="uniform_ratio",
        )  # fmt: skip
        parts.append(of_ratio)
    of_groups = tables["by_groups"].select(
        pl.col("group").alias("quantity"), pl.col("phase").alias("position"), "num_episodes", "num_tasks",
        *(pl.col(f"fraction{end}").alias(columns[end]) for end in ("", "_low", "_high")),
    )  # fmt: skip
    return pl.concat([*parts, of_groups], how="diagonal")


def _runs(tables: Mapping[str, pl.DataFrame]) -> pl.DataFrame:
    """A row for each quantity of a run and layer."""
    place, ends = ["run", "suite", "layer"], ("", "_low", "_high")
    cells = tables["runs"].filter(scope="all")
    counts = ["num_tasks", "num_families", "intervals", "num_episodes"]
    of = {"ratio": "geometric_mean", "ratio_lift": "ratio_lift", "success": "success_rate"}
    parts = [
        cells.select(
            *place, *counts, pl.lit(quantity).alias("quantity"), pl.col(name).alias("value"),
            *(pl.col(f"{name}{end}").alias(end[1:]) for end in ends[1:] if f"{name}{end}" in cells.columns),
            *(["uniform_ratio", "num_nonfinite", "episodes_without_ratio"] if quantity == "ratio" else []),
        )
        for quantity, name in of.items()
    ]  # fmt: skip
    groups = tables["runs_groups"].filter(scope="all")
    fractions = groups.select(
        *place, pl.format("{}_fraction", "group").alias("quantity"), value="fraction", low="fraction_low",
        high="fraction_high",
    ).join(cells.select(*place, *counts), on=place)  # fmt: skip
    return pl.concat([*parts, fractions], how="diagonal")


def _compared(tables: Mapping[str, pl.DataFrame]) -> pl.DataFrame:
    names = {"low": "difference_low", "high": "difference_high", "q": "difference_q", "num_pairs": "num_first"}
    return _renamed(tables["differences"], **names)


def _conditions(name: str) -> Callable[[Mapping[str, pl.DataFrame]], pl.DataFrame]:
    return lambda tables: tables[name].with_columns(condition="run")


#: A rerun has no success of its own.
_NO_OUTCOME = ~((pl.col("run") == "noise") & (pl.col("quantity") == "success"))
#: Differences of numbers that are equal to many digits keep few of them.
_OF_DIFFERENCES = 5e-6
_OF_MOVES = ("kind", "group", "selector", "phase", "mass", "lift", "norm", "keys", "random", "minus_random")
_ENDS = ("", "_low", "_high", "_episodes")
_CHANGED = ("effect", "effect_chunk", "angle", "gripper_flips", "noise", "minus_noise", "over_noise")
_COURSE = ("alignment", "outcome", "position_low", "position_high", "curve_low", "curve_high")
_OF_DENOISE = (
    "denoise_time", "scope", "suite", "task_id", "instruction", "layer", "layer_number", "block", "num_replans",
    "success_rate", "ratio_std", "ratio_median", "ratio_min", "ratio_max", "episodes_without_ratio", "num_nonfinite",
    "geometric_left_out", "nonfinite_layers", "numerator_mass", "denominator_mass", "ratio_mean", "ratio_mean_low",
    "ratio_mean_high", "ratio_of_means_low", "ratio_of_means_high",
)  # fmt: skip
_OF_EFFECTS = ("effect", "effect_chunk", "angle", "gripper_flips", "mass", "lift", "norm", "keys", "noise")
_WHOLE = pl.col("phase") == "all"
_WITH_ENDS = ("", "_low", "_high", "_episodes", "_q", "_p")


def _gone(*names: str) -> tuple[str, ...]:
    """The columns of values, with all that is said of them."""
    return tuple(f"{name}{end}" for name in names for end in _WITH_ENDS)


def _effects(tables: Mapping[str, pl.DataFrame]) -> pl.DataFrame:
    whole = tables["effects_summary"].with_columns(scope=pl.lit("all"))
    tasks = tables["1/effects_summary"].with_columns(scope=pl.lit("task"))
    return pl.concat([whole, tasks], how="diagonal")


#: (Case, the end of its name, or its command; kept table) -> how it is found.
FORMS: dict[tuple[str, str], Form] = {
    ("words", "words_summary"): Form(
        ("kind", "item"),
        lambda tables: (
            _renamed(tables["words"], pieces="keys")
            .filter(pl.col("kind") != "place")
            .with_columns(pl.col("item").replace(_SCALE))
        ),
        _WORDS_GONE,
    ),
    ("words", "words"): Form(
        (*_EPISODE, "layer", "kind", "item", "place"),
        lambda tables: (
            _renamed(tables["words_episodes"], pieces="keys")
            .filter(pl.col("kind") != "word")
            .with_columns(pl.col("kind").replace("place", "word"), pl.col("item").replace(_SCALE))
        ),
    ),
    ("objects", "objects"): Form(
        (*_EPISODE, "layer", "camera", "kind", "item"),
        lambda tables: tables["objects_episodes"],
        ("control_enrichment", "control_balanced", "control_overlap"),
    ),
    ("objects", "object_times"): Form(
        (*_EPISODE, "camera", "replan", "kind", "item"), lambda tables: tables["object_times"]
    ),
    ("objects", "objects_summary"): Form(
        ("camera", "kind", "item"),
        lambda tables: tables["objects"],
        (
            *(
                f"{name}{end}"
                for name in ("control_enrichment", "control_overlap", "enrichment_over_control")
                for end in ("", "_low", "_high", "_episodes")
            ),
            "enrichment_over_control_q",
            "share_episodes",
            "area_share_episodes",
            "enrichment_episodes",
        ),
    ),
    ("objects", "pointing"): Form(
        (*_EPISODE, "layer", "camera", "kind", "item"),
        lambda tables: tables["pointing_episodes"],
        ("centre_row_share", "centre_column_share"),
    ),
    ("objects", "pointing_summary"): Form(
        ("camera", "kind", "item"),
        lambda tables: tables["pointing"],
        tuple(
            f"{name}_episodes"
            for name in ("mask_patches", "distance", "distance_uniform", "pointing", "pointing_chance")
        ),
    ),
    ("objects", "iou"): Form(
        (*_EPISODE, "layer", "camera", "threshold", "kind", "item"),
        lambda tables: tables["iou_episodes"],
        still=pl.col("threshold") != "otsu",
    ),
    ("objects", "iou_summary"): Form(
        ("camera", "kind", "item", "threshold"),
        lambda tables: tables["iou"],
        ("iou_episodes", "iou_chance_episodes"),
        pl.col("threshold") != "otsu",
    ),
    ("analyze", "contributions"): Form(
        (*_EPISODE, "replan", "layer", "block", "denoise_step"), lambda tables: tables["contributions_steps"]
    ),
    ("heads", "heads"): Form(
        ("layer", "head"),
        _heads,
        ("log2_ratio_episodes", "log2_lift_episodes", "numerator_fraction_episodes"),
    ),
    ("heads", "heads_groups"): Form(
        ("layer", "head", "group"),
        lambda tables: tables["by_groups"].drop("layer").rename({"layer_number": "layer"}),
        ("fraction_episodes", "lift_episodes"),
    ),
    ("heads", "denoise"): Form(
        ("denoise_step",),
        lambda tables: _renamed(
            tables["1/by"], geometric_mean="ratio", geometric_mean_low="ratio_low", geometric_mean_high="ratio_high"
        ),
        _OF_DENOISE,
    ),
    ("heads", "denoise_groups"): Form(
        ("denoise_step", "group"),
        lambda tables: tables["1/by_groups"],
        (*_OF_DENOISE[:8], "mass", "density"),
    ),
    ("heads", "sinks"): Form((*_EPISODE[:2], "key"), lambda tables: tables["2/sinks"]),
    ("heads", "sink_heads"): Form((*_EPISODE[:2], "key", "layer", "head"), lambda tables: tables["2/sink_heads"]),
    ("export", "replans"): Form((*_EPISODE, "replan", "layer"), lambda tables: tables["1/replans"]),
    ("export", "replans_groups"): Form(
        (*_EPISODE, "replan", "layer", "group"), lambda tables: tables["1/replans_groups"]
    ),
    ("compare", "comparison"): Form(
        ("run", "scope", "suite", "task_id", "layer", "quantity"),
        _compared,
        ("block", "p", "d_z", "d_z_low", "d_z_high", "hedges_g", "hedges_g_low", "hedges_g_high", "layers_q"),
        _NO_OUTCOME,
        _OF_DIFFERENCES,
    ),
    ("compare", "pairs"): Form(
        ("run", "suite", "task_id", "episode_first", "layer", "quantity"),
        lambda tables: tables["pairs"],
        ("block",),
        _NO_OUTCOME,
        _OF_DIFFERENCES,
    ),
    ("compare", "runs"): Form(("run", "layer", "quantity"), _runs, ("block",), _NO_OUTCOME),
    ("reruns_compare", "effects"): Form(
        (*_EPISODE, "condition"), _conditions("moved_episodes"), (*_OF_MOVES, "instruction"), pl.col("phase") == "all"
    ),
    ("reruns_compare", "effects_summary"): Form(
        ("condition",),
        _conditions("moved"),
        (
            *_OF_MOVES[:4],
            "scope",
            "suite",
            "task_id",
            "instruction",
            "over_random",
            "minus_random_q",
            "minus_noise_q",
            *(f"{name}{end}" for name in (*_OF_MOVES[4:], "over_random") for end in _ENDS),
            *(f"{name}_episodes" for name in _CHANGED),
        ),
        (pl.col("phase") == "all") & (pl.col("scope") == "all"),
    ),
    ("effects", "effects"): Form(
        (*_EPISODE, "condition"),
        lambda tables: tables["effects_episodes"],
        ("phase", "group", "random", "minus_random"),
        _WHOLE,
    ),
    ("effects", "effects_summary"): Form(
        ("scope", "suite", "task_id", "condition"),
        _effects,
        (
            "phase",
            "group",
            *_gone("random", "minus_random", "over_random"),
            *(f"{name}_episodes" for name in (*_OF_EFFECTS, "over_noise", "minus_noise")),
        ),
        _WHOLE,
    ),
    ("effects", "effects_by_condition_plotted"): Form(
        ("condition",),
        lambda tables: tables["effects_summary"],
        ("row", "point"),
        pl.col("point").is_in(["without", "direct", "only"]),
    ),
    ("effects", "attention_and_effect_plotted"): Form(
        ("effect",),
        lambda tables: tables["effects_summary"],
        ("group",),
    ),
    ("deviation", "deviation"): Form(
        ("scope", "suite", "task_id"),
        lambda tables: tables["deviation"],
        ("phase", "first_episodes", "chunk_episodes"),
        _WHOLE,
    ),
    ("deviation", "deviation_dimensions"): Form(
        ("dimension",),
        lambda tables: tables["deviation_dimensions"],
        (*(f"{name}_episodes" for name in ("first", "chunk", "bias")), "bias_p"),
    ),
    ("deviation", "deviation_attention"): Form(
        ("quantity", "of", "measure"), lambda tables: tables["deviation_attention"], ("correlation_episodes",)
    ),
    ("time", "time_course"): Form(("quantity", "position"), _time_course, _COURSE),
}


def form_of(case: str, table: str) -> Form | None:
    """How a kept table of a case is found; None where today's has its name and form."""
    kind = case.rsplit("_", 1)[1]
    return FORMS.get((case, table)) or FORMS.get((kind, table)) or FORMS.get((CASES[case][0][0], table))


def alike(one: object, other: object, absolute: float = 1e-8) -> bool:
    """Whether two values are: numbers, also in text, to a hundred-thousandth; everything else exactly.

    Matrix products of other processors move effective numbers of keys by 2e-6.
    """
    if isinstance(one, list) and isinstance(other, list):
        return len(one) == len(other) and all(map(partial(alike, absolute=absolute), one, other))
    try:
        first, second = (float(value) for value in (one, other))  # type: ignore[arg-type]
    except (TypeError, ValueError):
        return one == other
    return (math.isnan(first) and math.isnan(second)) or math.isclose(first, second, rel_tol=1e-5, abs_tol=absolute)
