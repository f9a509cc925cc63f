"""The part `fuzz` of `reliability.py`: atheris gives made-up bytes to every parser of `tests/thorough/fuzz_targets.py`.

Usage: .venv-fuzz/bin/python benchmarks/reliability_fuzz.py TARGET --seconds 300 --folder FOLDER
`make fuzz` makes that environment and runs all targets.

What is found is kept once for each place in the code, in FOLDER/findings/TARGET, and the run goes on. An input that
hangs or takes all memory ends it, and is kept in the same place. FOLDER/corpus/TARGET grows from run to run.
Findings that were mended belong into `tests/thorough/fuzz/corpus`, whose files are tests.
"""

from __future__ import annotations

import argparse
import hashlib
import re
import resource
import subprocess
import sys
import time
import traceback
from collections.abc import Iterable
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "benchmarks")]

#: The largest input: of what is longer, the limits of the readers are tested elsewhere.
_MOST_BYTES = 16_384
#: An input that takes longer is a finding; the slowest valid one takes a tenth of a second.
_HANGS_AFTER_S = 20
_MOST_MEMORY_MB = 2_048
#: The net below: allocations beyond raise MemoryError.
_MOST_ADDRESSES = 16 * 2**30


def run(folder: Path, results: Any, seconds: float, targets: Iterable[str]) -> None:
    """Fuzz each target for its share of the seconds, in a process of its own; adds a case for each."""
    targets = list(targets)
    for target in targets:
        number = len([case for case in results.cases() if case["series"] == target])
        command = [sys.executable, __file__, target, "--folder", str(folder), "--seconds", str(seconds / len(targets))]
        began = time.monotonic()
        ended = subprocess.run(command, capture_output=True, text=True, check=False)
        took = time.monotonic() - began
        done = [line.split()[-1] for line in ended.stderr.splitlines() if "number_of_executed_units" in line]
        kept = sorted(path for path in (folder / "findings" / target).glob("*") if path.suffix != ".txt")
        problems = [f"{path.name} in {path.parent}" for path in kept]
        if not done:
            problems.append(f"the fuzzer ended with {ended.returncode}: {ended.stderr[-2000:]}")
        inputs = int(done[0]) if done else 0
        results.add({"series": target, "number": number, "inputs": inputs, "seconds": took, "problems": problems})


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("target")
    parser.add_argument("--seconds", type=float, default=60)
    parser.add_argument("--folder", type=Path, default=ROOT / "results" / "fuzz")
    arguments = parser.parse_args()
    import atheris

    with atheris.instrument_imports(include=["vla_attention"]):
        from tests.thorough import fuzz_targets
    if arguments.target not in fuzz_targets.TARGETS:
        parser.error(f"unknown target '{arguments.target}'; existing: {', '.join(fuzz_targets.TARGETS)}")
    corpus = arguments.folder / "corpus" / arguments.target
    findings = arguments.folder / "findings" / arguments.target
    for folder in (corpus, findings):
        folder.mkdir(parents=True, exist_ok=True)
    kept = ROOT / "tests" / "thorough" / "fuzz" / "corpus" / arguments.target
    for content in (*fuzz_targets.seeds(arguments.target), *(path.read_bytes() for path in sorted(kept.glob("*")))):
        (corpus / hashlib.sha1(content, usedforsecurity=False).hexdigest()).write_bytes(content)
    words = arguments.folder / f"{arguments.target}.words"
    words.write_text(_dictionary(path.read_bytes() for path in sorted(corpus.iterdir())[:50]))
    seen: set[str] = set()

    def test_one_input(content: bytes) -> None:
        try:
            fuzz_targets.run(arguments.target, content)
        except Exception as error:
            place = _place(error)
            if place not in seen:
                seen.add(place)
                name = hashlib.sha1(place.encode(), usedforsecurity=False).hexdigest()[:12]
                if not (findings / name).exists():
                    (findings / name).write_bytes(content)
                    (findings / f"{name}.txt").write_text("".join(traceback.format_exception(error)))
                    print(f"finding {name}: {place}", flush=True)

    resource.setrlimit(resource.RLIMIT_AS, (_MOST_ADDRESSES, _MOST_ADDRESSES))
    options = {
        "max_total_time": round(arguments.seconds),
        "max_len": _MOST_BYTES,
        "timeout": _HANGS_AFTER_S,
        "rss_limit_mb": _MOST_MEMORY_MB,
        "print_final_stats": 1,
        "dict": words,
        "artifact_prefix": f"{findings}/",
    }
    atheris.Setup([sys.argv[0], str(corpus), *(f"-{name}={value}" for name, value in options.items())], test_one_input)
    atheris.Fuzz()


def _dictionary(inputs: Iterable[bytes]) -> str:
    """The words in some inputs, as libFuzzer wants them: from them and with them, inputs are put together."""
    found = {word for content in inputs for word in re.findall(rb"[A-Za-z_]{2,20}:?", content)}
    return "".join(f'"{word.decode()}"\n' for word in sorted(found)[:500])


def _place(error: BaseException) -> str:
    """The kind of an error and the last line of this project that it passed."""
    frames = [frame for frame in traceback.extract_tb(error.__traceback__) if "vla_attention" in frame.filename]
    last = frames[-1] if frames else traceback.extract_tb(error.__traceback__)[-1]
    return f"{type(error).__name__} at {last.filename}:{last.name}:{last.line}"


if __name__ == "__main__":
    main()
