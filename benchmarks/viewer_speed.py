"""How quickly the page answers: the list, the first picture, layers and replans, on a store of full size.

Usage: python benchmarks/viewer_speed.py [--store PATH] [--rounds 5]
"""

from __future__ import annotations

import argparse
import os
import statistics
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from measurement import ROOT
from repeated_store import repeat_store

sys.path.insert(0, str(ROOT))

from tests.kit.browser import chromium, watched_page
from tests.kit.stores import StoreSpec, write_store
from tests.kit.tokens import libero_tokens
from tests.kit.viewer import ask, served

EPISODES, REPLANS = 500, 40


def make_store(path: Path) -> None:
    """Write the store: two episodes, repeated."""
    spec = StoreSpec(
        suite="libero_10",
        tasks=(0, 1),
        episodes=1,
        layers=tuple(range(18)),
        num_layers=18,
        heads=tuple(range(8)),
        num_action_queries=10,
        tokens=libero_tokens(REPLANS),
    )
    source = path.with_name(f"two_{path.name}")
    write_store(source, spec=spec)
    repeat_store(source, path, EPISODES // 2)


def measured(name: str, act: Callable[[int], Any], rounds: int) -> None:
    """Print the median, the lowest and the highest of some rounds."""
    found = []
    for number in range(rounds):
        begun = time.perf_counter()
        act(number)
        found.append(1000 * (time.perf_counter() - begun))
    print(f"{name:<46} {statistics.median(found):8.1f} ms  [{min(found):.1f}, {max(found):.1f}]  n={rounds}")


def measure(store: Path, rounds: int) -> None:
    """Print all figures of a store."""
    print(f"{store}: {EPISODES} episodes of {REPLANS} replans; load {os.getloadavg()[0]:.1f}")
    own = "runs/0/task000_episode000"
    with served(store) as server, chromium() as browser:

        def get(path: str) -> None:
            reply = ask(server, path)
            assert reply.status == 200, reply.body[:200]

        def shown(link: str) -> None:
            with watched_page(browser) as watched:
                watched.open(f"{server.link}{link}")

        def first_picture(number: int) -> None:
            with watched_page(browser) as watched:
                watched.page.goto(f"{server.link}#episode=task000_episode{number + 1:03d}")
                while not watched.page.evaluate("document.querySelector('.stack img')?.naturalWidth > 0"):
                    time.sleep(0.005)

        measured("the list of 500 episodes", lambda _: get("runs.json"), rounds)
        measured("its page in a new browser window", lambda _: shown(""), rounds)
        measured("an episode, first asked", lambda n: get(f"runs/0/task001_episode{n:03d}/about.json"), rounds)
        measured("the first picture in a new browser window", first_picture, rounds)
        measured("all of its page", lambda n: shown(f"#episode=task001_episode{n:03d}"), rounds)
        get(f"{own}/about.json")
        measured("a layer", lambda n: get(f"{own}/joint/rows/{n % 18}.npy"), 4 * rounds)
        measured("the mean of all layers", lambda _: get(f"{own}/joint/rows/mean.npy"), rounds)
        measured("every head of a layer", lambda n: get(f"{own}/joint/heads/{n % 18}.npy"), rounds)
        measured("a picture", lambda n: get(f"{own}/pictures/base_0_rgb/{n % REPLANS}.png"), 4 * rounds)
        measured("ratio and masses", lambda _: get(f"{own}/joint/groups/mean/mean.json"), rounds)
        measured("all heads on an object", lambda _: get(f"{own}/joint/grid/0.json"), rounds)
        with watched_page(browser) as watched:
            watched.open(f"{server.link}#episode=task000_episode000&layer=3")

            def press(key: str) -> None:
                watched.page.keyboard.press(key)
                watched.page.evaluate("new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))")
                watched.settle()

            measured("the next replan, drawn", lambda _: press("ArrowRight"), 4 * rounds)
            measured("the next layer, drawn", lambda _: press("]"), 2 * rounds)


def main() -> None:
    """Parse the arguments and measure."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--store", type=Path, help="the store; written unless it exists (default: a temporary one)")
    parser.add_argument("--rounds", type=int, default=5)
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        store = arguments.store or Path(folder) / "libero.zarr"
        if not store.exists():
            make_store(store)
        measure(store, arguments.rounds)


if __name__ == "__main__":
    main()
