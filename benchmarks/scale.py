"""Stores of thousands of episodes: how long listing takes and what it holds in memory, and what one episode costs.

Usage: OMP_NUM_THREADS=1 python benchmarks/scale.py [--store PATH] [--folder FOLDER] [--episodes 500 2000] [--rounds 3]

`listing`: stores of small whole episodes (39 keys; arrays, attributes and seals are those that a capture writes),
listed by commands in processes of their own; the times are with Python's start and the imports.

`parts`: of a store in the shape of pi0.5 in LIBERO (`--store`, written when it is not there), the processor seconds
that one episode costs the process that asks and the one that works, and the bytes that travel between them.
docs/my-cluster.md computes with them. Everything runs on one thread.
"""

from __future__ import annotations

import argparse
import os
import pickle
import sys
import tempfile
import time
from concurrent.futures import Executor, Future
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

from measurement import ROOT, ProcessCost, Table, fix_threads, measured, run_process, write_rows
from repeated_store import repeat_store

fix_threads(1)
sys.path.insert(0, str(ROOT))

TASKS = 10
#: What is listed, by its name in the table; {} is the store.
LISTINGS = {
    "`vla-attention analyze STORE --list`": ("-m", "vla_attention.analyze", "{}", "--list"),
    "`va.open(STORE).episodes`": ("-c", "import vla_attention as va; print(va.open('{}').episodes.height)"),
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--store", type=Path, help="store of `parts` (default: a temporary one of ten episodes)")
    parser.add_argument("--folder", type=Path, help="where stores are made, and kept (default: a temporary one)")
    parser.add_argument("--episodes", type=int, nargs="+", default=[500, 2000])
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--only", choices=("listing", "parts"))
    arguments = parser.parse_args()
    os.environ["VLA_CACHE"] = "off"  # every round measures
    with tempfile.TemporaryDirectory() as temporary:
        folder: Path = arguments.folder or Path(temporary)
        folder.mkdir(parents=True, exist_ok=True)
        if arguments.only != "parts":
            stores = {count: small_store(folder, count) for count in arguments.episodes}
            write_rows("scale", {"listing": listing_rows(stores, arguments.rounds)})
        if arguments.only != "listing":
            store: Path = arguments.store or folder / "libero.zarr"
            if not store.exists():
                from analysis_speed import make_store

                make_store(store, TASKS, replans=52, heads=8)
            write_rows("scale", {"parts": parts_rows(store, arguments.rounds)})


def small_store(folder: Path, episodes: int) -> Path:
    """A store of so many small episodes of ten tasks, unless it is there."""
    from tests.kit.stores import write_store

    path, first = folder / f"of_{episodes}.zarr", folder / "one_of_each.zarr"
    if not path.exists():
        if not first.exists():
            write_store(first, tasks=tuple(range(TASKS)), episodes=1, contributions=True)
        repeat_store(first, path, episodes // TASKS)
    return path


def listing_rows(stores: dict[int, Path], rounds: int) -> Table:
    """Seconds, processor seconds and peak memory of every listing of every store; all take turns."""
    costs: dict[tuple[str, int], list[ProcessCost]] = {}
    for number in range(rounds + 1):
        for name, words in LISTINGS.items():
            for count, store in stores.items():
                cost = run_process([sys.executable, *(word.format(store) for word in words)])
                if number:  # the first round warms the caches of the system
                    costs.setdefault((name, count), []).append(cost)
    rows = [
        {
            "what": name,
            "episodes": count,
            "seconds": measured([cost.seconds for cost in found]),
            "processor": measured([cost.processor_seconds for cost in found]),
            "peak": measured([cost.peak_mb for cost in found]),
        }
        for (name, count), found in costs.items()
    ]
    columns = {
        "what": "listed by",
        "episodes": "episodes",
        "seconds": "seconds",
        "processor": "processor seconds",
        "peak": "peak memory, MB",
    }
    return Table(columns, rows)


@dataclass
class Costs:
    """What a question costs, over all episodes of a store: processor seconds, and bytes that travel."""

    open: float = 0.0
    pack: float = 0.0
    work: float = 0.0
    unpack: float = 0.0
    tables: float = 0.0
    sent: int = 0
    answered: int = 0
    _began: float = field(default_factory=time.process_time, repr=False)

    def add(self, part: str) -> None:
        """The time since the last call belongs to this part."""
        now = time.process_time()
        setattr(self, part, getattr(self, part) + now - self._began)
        self._began = now


class OneByOne(Executor):
    """An executor that does in this process what workers do, and keeps the costs apart."""

    def __init__(self, costs: Costs) -> None:
        self._costs = costs

    def submit(self, function: Any, /, *given: Any, **named: Any) -> Future[Any]:
        costs = self._costs
        costs.add("tables")
        sent = pickle.dumps((function, given, named))
        costs.add("pack")
        called, words, keywords = pickle.loads(sent)  # noqa: S301 - made here
        answer = pickle.dumps(called(*words, **keywords))
        costs.add("work")
        result: Future[Any] = Future()
        result.set_result(pickle.loads(answer))  # noqa: S301 - made here
        costs.add("unpack")
        costs.sent += len(sent)
        costs.answered += len(answer)
        return result


def parts_rows(store: Path, rounds: int) -> Table:
    """What one episode costs the process that asks and a worker, for three questions; they take turns."""
    from vla_attention.analyze.commands.analyze import analyze
    from vla_attention.analyze.commands.words import words as ask_words
    from vla_attention.analyze.measures.question import ask
    from vla_attention.analyze.measures.question_settings import AnalysisSettings
    from vla_attention.analyze.stores import parallel
    from vla_attention.schemas.stores.reader import open_store

    words = AnalysisSettings(groups=("soup=word:soup", "v=role:image"), ratio="v/soup")
    questions = {
        "spans (`--grouping cameras`)": (AnalysisSettings(grouping="cameras"), analyze),
        "words (`--group soup=word:soup --group v=role:image`)": (words, analyze),
        "`vla-attention words`": (AnalysisSettings(), ask_words),
    }

    def costs_of(settings: AnalysisSettings, compute: Any) -> Costs:
        costs = Costs()
        question = ask([open_store(store)], settings)
        costs.add("open")
        token = parallel._elsewhere.set((OneByOne(costs), 1))
        compute(question)
        parallel._elsewhere.reset(token)
        costs.add("tables")
        return costs

    found: dict[str, list[Costs]] = {name: [] for name in questions}
    for number in range(rounds + 1):
        for name, (settings, compute) in questions.items():
            costs = costs_of(settings, compute)
            if number:
                found[name].append(costs)
    episodes = open_store(store).episodes
    size = sum(record.size for record in episodes[0].seal.files.values())
    per_episode = partial(_per_episode, number=len(episodes))
    rows = [{"what": name, **per_episode(costs)} for name, costs in found.items()]
    columns = {
        "what": "question",
        "open": "asking: opening, ms",
        "parcels": "asking: parcels, ms",
        "tables": "asking: tables, ms",
        "work": "worker, ms",
        "sent": "sent, kB",
        "answered": "answered, kB",
    }
    return Table(columns, rows, note=f"Per episode, of {len(episodes)} episodes with {size / 1e6:.1f} MB each.")


def _per_episode(costs: list[Costs], number: int) -> dict[str, Any]:
    milliseconds = partial(measured, factor=1000 / number)
    return {
        "open": milliseconds([one.open for one in costs]),
        "parcels": milliseconds([one.pack + one.unpack for one in costs]),
        "tables": milliseconds([one.tables for one in costs]),
        "work": milliseconds([one.work for one in costs]),
        "sent": round(costs[0].sent / number / 1000, 1),
        "answered": round(costs[0].answered / number / 1000, 1),
    }


if __name__ == "__main__":
    main()
