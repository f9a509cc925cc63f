"""What every command writes and says on fixed inputs, and whether two checkouts give the same.

    python scripts/outputs.py make FOLDER [--only TEXT]      with the checkout and the installation that run it
    python scripts/outputs.py compare BEFORE AFTER           exit code 1 and a list where they differ

Inputs: the golden stores, the example stores, a capture of the suite `cubes` by the policy that comes
along, one of Cosmos, one of LIBERO (where VLA_LIBERO_ASSETS names its assets), a policy recorded from its user's own
code, a data set made here, and the published results files of the tests. A change that is to alter no number and no
sentence is made between two calls of `make`.

Compared are bytes; of PNG files pixels; of JSON and of stores' attributes everything but `VARIES`; of texts everything
but durations, megabytes of memory and free disk. `EXPECTED` lists the files that a change may alter, with its reason.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import subprocess
import sys
from collections.abc import Iterator
from itertools import takewhile
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from vla_attention.schemas.stores.tar_files import unpack  # noqa: E402 - a script, and not part of the package

#: Names of JSON members that say when, where and with what a file was made, or digest what does.
VARIES = {
    "provenance", "created", "generated", "began", "at", "last_at", "date", "time", "tag", "process", "process_start",
    "process_space", "host", "store_bytes", "bytes", "mtime", "digest", "seconds", "sha256", "size", "crc32c",
}  # fmt: skip
#: Pattern of a file's path below the folder -> why it may differ. Committed before the change that it is about.
EXPECTED: dict[str, str] = {}

TWO_TASKS = ("--task-id", "0", "4", "--num-episodes", "1", "--max-steps", "15", "--num-envs", "1", "--threads", "1")
#: Of each golden and example store.
QUESTIONS = {
    "analyze": (),
    "cameras": ("--grouping", "cameras"),
    "heads": ("--by", "layer,head", "--csv"),
    "time": ("--by", "time"),
    "list": ("--list",),
    "without_sinks": ("--without-sinks",),
    "language": ("language",),
    "failures": ("failures",),
    "words": ("words",),
    "objects": ("objects",),
    "overlay": ("overlay",),
    "report": ("report",),
    "verify": ("store", "verify"),
}


def commands(folder: Path) -> Iterator[tuple[str, list[str]]]:
    """Names and words of all calls, in the order in which they are made; some read what an earlier one wrote."""
    cubes = "stores/cubes.zarr"
    yield "capture_cubes", ["capture", "pi", *TWO_TASKS, "--output", cubes]
    yield "capture_resume", ["capture", "pi", *TWO_TASKS, "--output", cubes, "--resume"]
    yield "capture_exists", ["capture", "pi", *TWO_TASKS, "--output", cubes]
    yield "capture_two_simulators", [
        "capture", "pi", *TWO_TASKS[:-4], "--num-envs", "2", "--policy-batch", "1", "--threads", "1",
        "--output", "stores/two.zarr",
    ]  # fmt: skip
    yield "capture_task", ["capture", "pi", "--task-id", "1", *TWO_TASKS[3:], "--output", "stores/task.zarr"]
    yield "capture_cosmos", [
        "capture", "cosmos", "--task-suite", "robosuite", "--task-id", "0", "--num-episodes", "1", "--max-steps",
        "6", "--threads", "1", "--num-envs", "1", "--output", "stores/cosmos.zarr",
    ]  # fmt: skip
    yield "capture_knockout", [
        "capture", "pi", *TWO_TASKS, "--knockout", "word:cube", "--prompt", "text:touch the blue cube",
        "--output", "stores/changed.zarr",
    ]  # fmt: skip
    if os.environ.get("VLA_LIBERO_ASSETS"):
        yield "capture_libero", [
            "capture", "pi", "--checkpoint", "untrained-tiny", "--task-suite", "libero_spatial", "--task-id", "0",
            "--num-episodes", "1", "--max-steps", "10", "--threads", "1", "--num-envs", "1",
            "--output", "stores/libero.zarr",
        ]  # fmt: skip
    rerun = ["capture", "rerun", cubes, "--check", "1", "--threads", "1"]
    yield "rerun", [*rerun, "--noise-seed", "3", "--output", "stores/noise.zarr"]
    yield "rerun_knockout", [*rerun, "--knockout", "role:instruction", "--output", "stores/unread.zarr"]
    yield "rerun_groups", [*rerun, "--effects", "text,grouping:default", "--output", "stores/groups.zarr"]
    replay = ["capture", "replay", "data", "--checkpoint", "untrained-tiny", "--threads", "1", "--every", "3"]
    replay += ["--camera", "base_0_rgb=front", "--camera", "left_wrist_0_rgb=none"]
    yield "replay", [*replay, "--output", "stores/replay.zarr"]
    yield "status", ["capture", "status", cubes]
    yield "status_json", ["capture", "status", cubes, "--json"]
    yield "tasks", ["capture", "tasks", "cubes"]
    yield "capture_verify", ["capture", "verify", cubes]
    yield "capture_repair", ["capture", "verify", cubes, "--repair", "--quick"]
    yield "doctor", ["capture", "doctor", "--output", cubes, "--threads", "1"]
    for place in _stores(folder):
        kind = place.removeprefix("stores/").replace("/", "_").removesuffix(".zarr")
        for name, words in QUESTIONS.items():
            output = [] if name == "verify" else ["--output", f"results/{kind}_{name}"]
            before = list(takewhile(lambda word: not word.startswith("--"), words))
            yield f"{kind}_{name}", [*(before or ["analyze"]), place, *words[len(before) :], *output]
    example = "stores/example"
    base = f"{example}/cubes.zarr"
    yield "compare", ["compare", base, f"{example}/cubes_one_colour.zarr", "--output", "results/compare"]
    yield "effects", ["effects", base, "--output", "results/effects"]
    yield "report_effects", ["report", base, "--output", "results/report_effects"]
    yield "effects_of_data", ["effects", "stores/replay.zarr", "--output", "results/effects_of_data"]
    yield "own_groups", [
        "analyze", base, "--group", "colour=word:red,word:green,word:blue", "--group", "seen=role:image", "--ratio",
        "seen/colour", "--output", "results/own_groups",
    ]  # fmt: skip
    yield "copy", ["store", "copy", base, "stores/copied.zarr", "--without", "frames"]
    yield "tar", ["store", "copy", cubes, "stores/tars.zarr", "--tar"]
    yield "unpack", ["store", "copy", "stores/tars.zarr", "stores/unpacked.zarr"]
    yield (
        "merge",
        ["store", "copy", "stores/unpacked.zarr", "stores/task.zarr", "-o", "stores/merged.zarr"],
    )
    yield "merge_refused", ["store", "copy", cubes, "stores/two.zarr", "-o", "stores/refused.zarr"]
    for name, words in {
        "no_store": ("analyze", "nowhere.zarr"),
        "unknown_group": ("analyze", base, "--group", "a=word:zebra"),
        "unknown_layer": ("analyze", base, "--layers", "77"),
        "unknown_command": ("rations", base),
    }.items():
        yield name, list(words)
    yield "help", ["--help"]
    yield "capture_help", ["capture", "--help"]
    for name in _commands_of("analyze"):
        yield f"analyze_{name}_help", [name, "--help"]
    for name in ("pi", "cosmos", "rerun", "replay", "status", "doctor", "tasks", "verify"):
        yield f"capture_{name}_help", ["capture", name, "--help"]


def _commands_of(stage: str) -> list[str]:
    assert stage == "analyze"
    from vla_attention.analyze.registry import COMMANDS

    return list(COMMANDS)


def _stores(folder: Path) -> list[str]:
    """Golden and example stores, the run of cubes, and one recorded by a policy's user."""
    golden = sorted(str(path.relative_to(folder)) for path in (folder / "stores/golden").glob("*.zarr"))
    own = ["stores/cubes.zarr", "stores/cosmos.zarr", "stores/recorded.zarr", "stores/replay.zarr"]
    libero = ["stores/libero.zarr"] if os.environ.get("VLA_LIBERO_ASSETS") else []
    return [*golden, "stores/example/cubes.zarr", *own, *libero]


def make(folder: Path, only: str) -> int:
    """Run all commands below a new folder."""
    folder.mkdir(parents=True)
    stores = folder / "stores"
    for place, inside in (("tests/golden/stores", "golden"), ("vla_attention/example_stores", "example")):
        for archive in sorted((ROOT / place).glob("*.tar.xz")):
            unpack(archive, stores / inside)
    subprocess.run([sys.executable, __file__, "--inputs", str(folder)], check=True)
    environment = os.environ | {
        "OMP_NUM_THREADS": "1", "VLA_CACHE": "off", "SOURCE_DATE_EPOCH": "0", "COLUMNS": "120", "NO_COLOR": "1",
        "MPLBACKEND": "agg", "PYTHONHASHSEED": "0",
    }  # fmt: skip
    (folder / "said").mkdir()
    for name, words in commands(folder):
        if only not in name:
            continue
        call = [sys.executable, "-m", "vla_attention", *words]
        done = subprocess.run(call, cwd=folder, env=environment, capture_output=True, text=True, check=False)
        said = (
            f"$ vla-attention {' '.join(words)}\n{done.stdout}\n--- stderr\n{done.stderr}\n--- exit {done.returncode}\n"
        )
        (folder / "said" / f"{name}.txt").write_text(said)
        print(f"{done.returncode} {name}", flush=True)
    return 0


def make_inputs(folder: Path) -> None:
    """Write what the commands read and none writes, in a process of its own: it loads torch and the tests' kit."""
    os.chdir(folder)
    from tests.golden.make_stores import _record
    from tests.kit.lerobot_data_sets import made_up_episodes, write_data_set

    _record(Path("stores/recorded.zarr"))
    write_data_set(Path("data"), "v2.1", made_up_episodes(state=8, action=7))


_DURATION = re.compile(
    r"\b\d+(?:\.\d+)?(?:e-?\d+)? ?(?:s|min|ms|h)\b|\b\d\d:\d\d:\d\d\b|\d+(?:\.\d+)? [GMk]B (?:free|available)"
)


def _plain(value: Any) -> Any:
    """A JSON value without what varies between two runs."""
    if isinstance(value, dict):
        return {name: _plain(member) for name, member in value.items() if name not in VARIES}
    if isinstance(value, list):
        return [_plain(member) for member in value]
    return value


def _content(path: Path, folder: Path) -> object:
    """What is compared of a file."""
    content = path.read_bytes()
    if path.suffix == ".png":
        from PIL import Image

        with Image.open(path, formats=["PNG"]) as image:
            return image.size, image.mode, image.tobytes()
    if path.suffix == ".json":
        return _plain(json.loads(content))
    if path.suffix in (".txt", ".html", ".csv"):
        return _DURATION.sub("DURATION", content.decode().replace(str(folder.resolve()), "FOLDER"))
    return content


def compare(before: Path, after: Path) -> int:
    """Print what differs; 1 where anything does that is not expected."""
    files = [
        {str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file() and ".log/" not in str(path)}
        for folder in (before, after)
    ]
    wrong = [f"only before: {name}" for name in sorted(files[0] - files[1])]
    wrong += [f"only after: {name}" for name in sorted(files[1] - files[0])]
    for name in sorted(files[0] & files[1]):
        one, other = _content(before / name, before), _content(after / name, after)
        if one != other:
            wrong.append(f"differs: {name}{_first_difference(one, other)}")
    expected = [line for line in wrong if any(re.search(pattern, line) for pattern in EXPECTED)]
    for line in wrong:
        print("expected," if line in expected else "", line)
    print(f"{len(files[0] | files[1])} files, {len(wrong)} differ, {len(expected)} of them as expected.")
    return int(len(wrong) > len(expected))


def _first_difference(one: object, other: object) -> str:
    if isinstance(one, dict | list) and isinstance(other, type(one)):
        one, other = (json.dumps(value, indent=0, sort_keys=True) for value in (one, other))
    if isinstance(one, str) and isinstance(other, str):
        pairs = zip(one.splitlines(), other.splitlines(), strict=False)
        first = next(((a, b) for a, b in pairs if a != b), ("", "a line more or less"))
        return f"\n    {first[0][:160]}\n    {first[1][:160]}"
    return ""


def main() -> int:
    """Run the command line; returns the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parsers = parser.add_subparsers(dest="act", required=True)
    making = parsers.add_parser("make")
    making.add_argument("folder", type=Path)
    making.add_argument("--only", default="", metavar="TEXT", help="commands whose name has this text")
    comparing = parsers.add_parser("compare")
    comparing.add_argument("before", type=Path)
    comparing.add_argument("after", type=Path)
    given = parser.parse_args()
    return make(given.folder.resolve(), given.only) if given.act == "make" else compare(given.before, given.after)


if __name__ == "__main__":
    if sys.argv[1:2] == ["--inputs"]:
        make_inputs(Path(sys.argv[2]))
    else:
        sys.exit(main())
