"""How long the viewer's page takes: to the first picture, for another layer, head or step, and how many bytes it reads.

Usage: python benchmarks/viewer_speed.py [--store PATH] [--rounds 5]

Writes a store of the shape of pi0.5 in LIBERO unless it exists (978 keys, 18 layers, 8 heads, two denoise steps,
pictures; episodes of 40 replans, two of which are made and the others are the same again, about 1 GB in all), serves it
with the viewer's own server, and drives the machine's Chromium with playwright. It prints medians with the lowest and
the highest, and asserts nothing.
"""

from __future__ import annotations

import argparse
import os
import statistics
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from measurement import ROOT
from repeated_store import repeat_store

sys.path.insert(0, str(ROOT))

from tests.kit.browser import Watched, chromium, watched_page
from tests.kit.stores import StoreSpec, write_store
from tests.kit.tokens import libero_tokens
from tests.kit.viewer import served

EPISODES, REPLANS = 50, 40


def make_store(path: Path) -> None:
    """Write the store; two episodes take half a minute."""
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


def shown(name: str, values: Sequence[float], unit: str) -> str:
    """A line: the median, the lowest and the highest."""
    middle = statistics.median(values)
    return f"{name:<52} {middle:8.1f} {unit}  [{min(values):.1f}, {max(values):.1f}]  n={len(values)}"


def first_pictures(browser: Any, server: Any, rounds: int) -> list[float]:
    """Seconds from asking for the link to a whole page, each time in a browser that knows nothing of it."""
    found = []
    for _ in range(rounds):
        with watched_page(browser) as watched:
            begun = time.perf_counter()
            watched.open(server.link)
            found.append(time.perf_counter() - begun)
    return found


def changes(watched: Watched, act: Callable[[], None], times: int) -> list[float]:
    """Milliseconds from a change of the state until all is drawn, as the page measures it."""
    found = []
    for _ in range(times):
        before = watched.page.evaluate("window.viewer.timings.length")
        act()
        while watched.page.evaluate("window.viewer.timings.length") == before:
            time.sleep(0.005)
        found.append(float(watched.page.evaluate("window.viewer.timings.at(-1).ms")))
        # A person takes a moment, in which the page reads ahead.
        time.sleep(0.4)
    return found


def measure(store: Path, rounds: int) -> None:
    """Print all figures of a store."""
    size = sum(path.stat().st_size for path in store.rglob("*") if path.is_file())
    print(f"{store}: {size / 1e9:.2f} GB in {EPISODES} episodes of {REPLANS} replans; load {os.getloadavg()[0]:.1f}")
    with served(store) as server, chromium() as browser:
        print(shown("first picture", first_pictures(browser, server, rounds), "s "))
        server.sent.clear()
        with watched_page(browser) as watched:
            watched.open(server.link)
            time.sleep(1)
            rows = sum(count for name, count in server.sent.items() if "/rows/" in name)
            print(
                f"read for the first picture: {sum(server.sent.values()) / 1e6:.2f} MB, {rows / 1e6:.2f} MB of it rows"
            )
            press = watched.page.keyboard.press
            for name, link, key, times in (
                ("another replan, all layers", "?replan=3", "ArrowRight", 20),
                ("another replan, one layer", "?layer=9&replan=3", "ArrowRight", 20),
                ("the next layer, read ahead", "?layer=3", "]", 10),
                ("another head", "?layer=9", ".", 7),
                ("another denoise step", "?layer=9&head=3", "+", 2),
                ("values: raw, rank, lift", "?layer=9", "v", 6),
            ):
                watched.open(f"{server.link}{link}")
                time.sleep(0.5)
                print(shown(name, changes(watched, lambda key=key: press(key), times), "ms"))
            watched.open(f"{server.link}?layer=0")
            layers = iter((5, 10, 15, 7, 12, 17))

            def far_layer() -> None:
                watched.page.select_option('select[name="layer"]', str(next(layers)))

            server.sent.clear()
            print(shown("a layer that was not read before", changes(watched, far_layer, 6), "ms"))
            print(f"read for each of them, with the layers beside it: {sum(server.sent.values()) / 6e6:.2f} MB")


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
