"""The golden tables: what every question gives on fixed stores, and what the published lines pass on.

`tests/golden/tables/CASE/TABLE.parquet` holds a table of a command's results; `python -m tests.golden.make_tables` made
them. Numbers that were kept when commands had other forms are in today's form since they were found equal in it.
`report` has no case: it writes a page of the other questions' results, and no tables. Columns of `language` and
`failures` that hold phrases of ours are not kept.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import shlex
import shutil
import subprocess
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import polars as pl
import pytest

from tests.kit.archives import unpacked
from tests.kit.paths import GOLDEN, ROOT
from vla_attention.__main__ import main as vla_attention
from vla_attention.analyze.published.parse_results import build_parser as parser_of_results
from vla_attention.analyze.published.parse_results import main as parse_attention_ratio_results
from vla_attention.analyze.render import figures
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
    "cubes_language": (("language", "cubes.zarr"), ("language", "one_colour.zarr")),
    "effects_language": (("language", "effects.zarr"),),
    "pair_failures": (("failures", "one_colour.zarr", "--twins", "cubes.zarr"),),
    "cubes_overlay": (("overlay", "cubes.zarr", "--num-replans", "3"),),
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
        patch.setattr(figures, "content", lambda _figure, _style, kinds: ([b""] * len(kinds), 1.0))
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
    (line,) = [line for line in printed if "vla-attention capture" in line and "--task-suite" in line]
    _, _, *given = shlex.split(line)
    return build_parser(given).parse_args(given)


def _options(arguments: argparse.Namespace) -> Iterator[tuple[str, str]]:
    for name, value in sorted(vars(arguments).items()):
        if not callable(value) and name != "family" and value not in (None, False, []):
            yield name, str(value)


#: Differences of numbers that are equal to many digits keep few of them, as do logarithms of numbers near 1, and
#: standard deviations of numbers that hardly differ.
OF_DIFFERENCES, OF_LOGARITHMS, OF_DEVIATIONS = 5e-6, 2e-6, 2e-7


def alike(column: str, one: object, other: object, absolute: float = OF_DEVIATIONS) -> bool:
    """Whether two values are: numbers, also in text, to a hundred-thousandth; everything else exactly.

    Sums in float32 err by some 1e-7 of another processor's (`pytest --jitter` has them on this one). Probabilities of
    tests keep three digits of that.
    """
    if isinstance(one, list) and isinstance(other, list):
        same = partial(alike, column, absolute=absolute)
        return len(one) == len(other) and all(map(same, one, other))
    try:
        first, second = (float(value) for value in (one, other))  # type: ignore[arg-type]
    except (TypeError, ValueError):
        return one == other
    relative = 1e-3 if column in ("p", "q") or column.endswith(("_p", "_q")) else 1e-5
    absolute = max(absolute, OF_LOGARITHMS) if column.startswith("log2") else absolute
    return (math.isnan(first) and math.isnan(second)) or math.isclose(first, second, rel_tol=relative, abs_tol=absolute)
