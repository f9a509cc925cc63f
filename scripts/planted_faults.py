"""Plant faults one at a time in copies of the checkout: the gate's tests have to fail for each.

    python scripts/planted_faults.py [NAME ...] [--workers 2]

A fault is a piece of code and what stands there instead. It meets the tests of its area first; those that let it pass
are followed by the whole gate. Before anything is planted, the tests of all areas have to pass. The table names the
test that caught each fault. Exit code 1: a fault was not caught, or does not apply any more; whoever moves its place
mends it here.
"""

from __future__ import annotations

import argparse
import importlib.util
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from queue import Queue

ROOT = Path(__file__).resolve().parents[1]
#: What a copy does not need.
LEFT_OUT = shutil.ignore_patterns(
    ".git", ".venv*", ".*_cache", ".hypothesis", "__pycache__", "runs", "results", "site", "node_modules", "*.egg-info"
)
CORE, GOLDEN, STORE = "tests/analyze/core", "tests/test_golden_tables.py", "tests/capture/store"


@dataclass(frozen=True)
class Fault:
    """before: a piece of code that stands once in the file; after: what is planted; tests: those of its area."""

    name: str
    file: str
    before: str
    after: str
    tests: tuple[str, ...]


FAULTS = (
    Fault(
        "wrong whole: a fraction is of all valid keys instead of the groups",
        "analyze/core/measure.py",
        "share = np.where(whole > 0, mass / whole, np.nan)",
        "share = np.where(whole > 0, mass / valid, np.nan)",
        (CORE, GOLDEN),
    ),
    Fault(
        "span off by one: a camera without its last patch",
        "schemas/groupings/selectors.py",
        "camera_spans(argument):\n        member[0, span.start : span.stop] = True",
        "camera_spans(argument):\n        member[0, span.start : span.stop - 1] = True",
        ("tests/schemas/groupings",),
    ),
    Fault(
        "visual and linguistic swapped",
        "analyze/core/levels.py",
        "zip(SIDES, (grouping.ratio.numerator, grouping.ratio.denominator), strict=True)",
        "zip(SIDES, (grouping.ratio.denominator, grouping.ratio.numerator), strict=True)",
        (CORE, GOLDEN),
    ),
    Fault(
        "wrong layer numbers: call 25 is block 6",
        "schemas/layers.py",
        "return tuple(number % num_layers for number in numbers)",
        "return tuple(number % (num_layers + 1) for number in numbers)",
        ("tests/schemas/test_layout_words_and_layers.py", "tests/analyze/stores"),
    ),
    Fault(
        "dropped mask",
        "capture/recording/attention.py",
        "    if mask is not None:\n        logits.masked_fill_",
        "    if mask is not None and change is not None:\n        logits.masked_fill_",
        ("tests/capture/recording", "tests/capture/policies/pi"),
    ),
    Fault(
        "wrong rounding: cut instead of rounded",
        "schemas/precision.py",
        "((raw + half + odd) & mask)",
        "(raw & mask)",
        ("tests/schemas/test_precision.py", STORE),
    ),
    Fault(
        "lost fsync before a file gets its name",
        "schemas/stores/durable_files.py",
        "    _flush(file)\n    file.replace(target)",
        "    file.replace(target)",
        (STORE, "tests/schemas/stores"),
    ),
    Fault(
        "two writers: a living holder is replaced",
        "schemas/stores/locks.py",
        "too_long = silent >= (",
        "too_long = silent >= 0 * (",
        ("tests/schemas/stores/test_locks.py", "tests/capture/engine"),
    ),
    Fault(
        "wrong weight of denoise steps: the last one alone",
        "analyze/core/measure.py",
        "values = values.mean(axis=gone, keepdims=True)",
        'values = (values if "denoise" in by else values[:, :, -1:]).mean(axis=gone, keepdims=True)',
        (CORE, GOLDEN),
    ),
    Fault(
        "wrong degrees of freedom: families less one",
        "analyze/statistics/intervals.py",
        "    degrees = np.where(np.abs(degrees - whole) < _WHOLE, whole, degrees)",
        "    degrees = np.where(whole > 0, (size > 0).sum(axis=-1) - 1.0, degrees)",
        ("tests/analyze/statistics",),
    ),
    Fault(
        "listening: what was reached last counts, so a policy that tries everything does as told",
        "analyze/core/behaviour.py",
        'pl.col("held") == pl.min("held").over(episode)',
        'pl.col("held") == pl.max("held").over(episode)',
        ("tests/analyze/commands/test_language.py",),
    ),
    Fault(
        "leaving: a centimetre, however far solved episodes are from one another",
        "analyze/core/courses.py",
        "band([np.zeros(1)] if same_state else own, len(apart))",
        "band([np.zeros(1)], len(apart))",
        ("tests/analyze/commands/test_failures.py",),
    ),
    Fault(
        "stale cache key: files that changed since",
        "analyze/cache/remembered.py",
        "hashlib.sha256(question.digest + state + about)",
        "hashlib.sha256(question.digest + about)",
        ("tests/analyze/cache",),
    ),
    Fault(
        "swallowed exception: an episode that fails is left out",
        "capture/engine/loop.py",
        "(StoreExists, *EPISODE_FAULTS) as error:\n            self._fail(running, error)",
        "Exception as error:\n            self._fail(running, StoreExists(str(error)))",
        ("tests/capture/engine", "tests/capture/rerun"),
    ),
    Fault(
        "picture turned",
        "capture/policies/pi/preprocess.py",
        "np.ascontiguousarray(picture[::-1, ::-1])",
        "np.ascontiguousarray(picture[::-1])",
        ("tests/capture/policies/pi",),
    ),
    Fault(
        "wrong unit in a table: radians for degrees",
        "analyze/core/action_changes.py",
        "angle: Array = np.degrees(",
        "angle: Array = np.abs(",
        ("tests/analyze/core/test_action_changes.py", GOLDEN),
    ),
    Fault(
        "ignored option: --denoise",
        "analyze/stores/selection.py",
        'if words is None or list(words) == ["all"]:',
        "if words is None or len(words) > 0:",
        ("tests/analyze/stores", CORE),
    ),
    Fault(
        "wrong seed: the same noise at every replan",
        "capture/policies/noise.py",
        "[run_seed, task_id, episode_index, replan]",
        "[run_seed, task_id, episode_index, 0]",
        ("tests/capture/policies/test_noise.py",),
    ),
    Fault(
        "effect of the wrong reader: all queries for the action queries",
        "capture/effects/conditions.py",
        '"action": ("action", "")',
        '"action": ("all", "")',
        ("tests/capture/effects",),
    ),
    Fault(
        "wrong baseline: one share of all keys, seen or not",
        "schemas/groupings/key_counts.py",
        "number = seen.sum(axis=-1, keepdims=True)",
        "number = np.full((*seen.shape[:-1], 1), seen.shape[-1])",
        ("tests/schemas", CORE),
    ),
    Fault(
        "prompt of another row of the batch",
        "capture/policies/pi/policy.py",
        "torch.cat([each.tensors[name] for each in policy_inputs])",
        'torch.cat([each.tensors[name] for each in policy_inputs]).roll(int(name == "tokens"), 0)',
        ("tests/capture/engine/test_simulators.py",),
    ),
    Fault(
        "resumed twice: a committed episode is recorded again",
        "capture/engine/loop.py",
        "return self.store.has(job.task.task_id, job.episode_index)",
        "return False",
        ("tests/capture/engine", "tests/capture/rerun"),
    ),
    Fault(
        "exchange: words of the sentence that was not told count as heard",
        "analyze/core/exchanged.py",
        'told, scene = words_by_kind(row["told"]), words_by_kind(row["scene_instruction"])',
        'scene, told = words_by_kind(row["told"]), words_by_kind(row["scene_instruction"])',
        (f"{CORE}/test_exchanged.py",),
    ),
    Fault(
        "perturbed suites: a task weighs as much as it has episodes",
        "analyze/core/perturbations.py",
        'suites = tasks.group_by("suite").agg(pl.sum("num_episodes"), *means)',
        'suites = rows.group_by("suite").agg(pl.len().alias("num_episodes"), *means)',
        (f"{CORE}/test_perturbations.py",),
    ),
    Fault(
        "courses: a replan's mean over the moments before its steps",
        "analyze/core/courses.py",
        "moments[begin + 1 : end + 1].mean()",
        "moments[begin:end].mean()",
        (f"{CORE}/test_courses.py",),
    ),
    Fault(
        "attention elsewhere: an episode's own places count as other ones",
        "analyze/core/object_maps.py",
        "for name in _names(one)], axis=-1) - own",
        "for name in _names(one)], axis=-1)",
        (f"{CORE}/test_object_maps.py",),
    ),
    Fault(
        "naming: what a task's own episodes do not name counts as another task's",
        "analyze/core/naming.py",
        "(mean.sum(axis=1)[strata] - mean[strata, tasks]) / (there.sum(axis=1)[strata] - there[strata, tasks])",
        "mean.sum(axis=1)[strata] / there.sum(axis=1)[strata]",
        (f"{CORE}/test_naming.py",),
    ),
    Fault(
        "left out: an episode of a task has all of what the statistic loses",
        "analyze/statistics/left_out.py",
        "part.num_tasks * (size - 1)[part.tasks]",
        "part.num_tasks * size[part.tasks]",
        ("tests/analyze/statistics/test_left_out.py",),
    ),
    Fault(
        "masked softmax: a query that its mask leaves no key sees all",
        "capture/torch_policies/call_tensors.py",
        "(logits > highest + MASKED_BELOW) & (highest > MASKED_BELOW)",
        "(logits > highest + MASKED_BELOW)",
        ("tests/capture/torch_policies/test_softmax_calls.py",),
    ),
    Fault(
        "effect of other noise: that of the first replan at every one",
        "capture/effects/measurement.py",
        "condition.noise.seed, context.task_id, context.episode_index, context.replan",
        "condition.noise.seed, context.task_id, context.episode_index, 0",
        ("tests/capture/effects/test_measurement.py",),
    ),
    Fault(
        "recording for Rerun: turned with w first",
        "analyze/view/rrd_file.py",
        "np.roll(poses[:, i, 3:], -1, axis=1)",
        "poses[:, i, 3:]",
        ("tests/analyze/view/test_rrd_file.py",),
    ),
)


def copy_checkout(folder: Path) -> Path:
    """Copy what the tests need, with the package's links as links."""
    return Path(shutil.copytree(ROOT, folder, symlinks=True, ignore=LEFT_OUT))


def run_tests(copy: Path, words: Sequence[str]) -> tuple[int, str]:
    """Run tests of a copy with the package of that copy; returns pytest's exit code and what it printed."""
    environment = os.environ | {"PYTHONPATH": str(copy), "CI": "true", "OMP_NUM_THREADS": "1"}
    assets = ROOT.parent / "shared" / "libero-assets"
    if assets.is_dir():
        environment.setdefault("VLA_LIBERO_ASSETS", str(assets))
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", *words]
    done = subprocess.run(command, cwd=copy, env=environment, capture_output=True, text=True, check=False)
    return done.returncode, done.stdout + done.stderr


def plant(fault: Fault, copy: Path) -> str:
    """Hold a fault against its area's tests, then against all; returns the test that failed, or nothing."""
    file = copy / fault.file
    whole = file.read_text(encoding="utf-8")
    try:
        write(file, whole.replace(fault.before, fault.after))
        for words in (fault.tests, ()):
            code, printed = run_tests(copy, ["-x", *words])
            if code == 1:
                failed = re.findall(r"^(?:FAILED|ERROR) (.+?)(?: - .*)?$", printed, re.MULTILINE)
                return failed[0] if failed else "(no name)"
            if code != 0:
                raise RuntimeError(f"pytest ended with {code} for {fault.name}:\n{printed[-2000:]}")
        return ""
    finally:
        write(file, whole)


def write(file: Path, text: str) -> None:
    """Write a module, and remove what was compiled of it: two texts of one length and second look the same."""
    file.write_text(text, encoding="utf-8")
    Path(importlib.util.cache_from_source(str(file))).unlink(missing_ok=True)


def inapplicable(faults: Sequence[Fault]) -> list[str]:
    """What does not stand in the checkout exactly once, or has no tests."""
    found = []
    for fault in faults:
        count = (
            (ROOT / fault.file).read_text(encoding="utf-8").count(fault.before) if (ROOT / fault.file).exists() else 0
        )
        lacking = [name for name in fault.tests if not (ROOT / name).exists()]
        if count != 1:
            found.append(f"{fault.name}: its code stands {count} times in {fault.file}; expected once")
        found += [f"{fault.name}: there is no {name}" for name in lacking]
    return found


def main() -> int:
    """Plant the faults, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", help="faults whose name begins so (default: all)")
    parser.add_argument("--workers", type=int, default=2)
    given = parser.parse_args()
    faults = [fault for fault in FAULTS if not given.names or fault.name.startswith(tuple(given.names))]
    if not faults:
        parser.error(f"no fault begins with {given.names}; there are: {'; '.join(fault.name for fault in FAULTS)}")
    if wrong := inapplicable(faults):
        print("\n".join(wrong))
        return 1
    begin, workers = time.monotonic(), min(given.workers, len(faults))
    with tempfile.TemporaryDirectory(prefix="planted_faults_") as temporary:
        copies: Queue[Path] = Queue()
        for number in range(workers):
            copies.put(copy_checkout(Path(temporary) / f"copy{number}"))
        areas = sorted({name for fault in faults for name in fault.tests})
        code, printed = run_tests(Path(temporary) / "copy0", ["-n", str(workers), *areas])
        if code:
            print(f"Tests fail before anything is planted:\n{printed[-3000:]}")
            return 1
        print(f"The tests of {len(areas)} areas pass; {time.monotonic() - begin:.0f} s.", flush=True)

        def hold(fault: Fault) -> bool:
            copy, start = copies.get(), time.monotonic()
            try:
                caught = plant(fault, copy)
            finally:
                copies.put(copy)
            print(f"{fault.name:<66} {time.monotonic() - start:4.0f} s  {caught or 'NOT CAUGHT'}", flush=True)
            return bool(caught)

        with ThreadPoolExecutor(workers) as pool:
            results = list(pool.map(hold, faults))
    print(f"{sum(results)} of {len(faults)} caught, in {(time.monotonic() - begin) / 60:.1f} minutes.")
    return int(not all(results))


if __name__ == "__main__":
    sys.exit(main())
