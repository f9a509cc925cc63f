"""Roots of stores: the run's attributes, in which nothing has to be true."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

from tests.thorough.hostile.changes import Case, edit_root

#: What a root says first of every problem.
REFUSED = r"The store .*a\.zarr cannot be read: .*"


def _set(*places: Any) -> Callable[[Path], None]:
    """A change of the root: the last of `places` is put where the others lead."""
    *path, last, value = places

    def change(attributes: dict[str, Any]) -> None:
        holder: Any = attributes
        for part in path:
            holder = holder[part]
        holder[last] = value

    return lambda store: edit_root(store, change)


def _raw(replaced: str, by: str) -> Callable[[Path], None]:
    """A change of the text of the root, of which no JSON has to remain."""

    def make(store: Path) -> None:
        root = store / "zarr.json"
        text = root.read_text()
        assert replaced in text
        root.write_text(text.replace(replaced, by, 1))

    return make


def _instead(make: Callable[[Path], object]) -> Callable[[Path], None]:
    """Something else in place of the root's zarr.json."""

    def change(store: Path) -> None:
        (store / "zarr.json").unlink()
        make(store / "zarr.json")

    return change


def _outside(root: Path) -> None:
    target = root.parent.parent / "outside.json"
    target.write_text("{}")
    root.symlink_to(target)


def _sparse(root: Path) -> None:
    with root.open("wb") as file:
        file.truncate(10**12)


def _spans(count: int) -> list[dict[str, Any]]:
    return [{"name": f"s{i}", "kind": "state", "start": i, "stop": i + 1} for i in range(count)]


def _far(store: Path) -> None:
    """A camera of a huge grid, with the spans behind it moved."""

    def change(attributes: dict[str, Any]) -> None:
        span = attributes["sites"][0]["spans"][0]
        rows = span["grid"]["rows"] = 10**9
        more = rows * span["grid"]["columns"] - span["stop"]
        for other in attributes["sites"][0]["spans"]:
            other["stop"] += more
            if other is not span:
                other["start"] += more

    edit_root(store, change)


def _many_sites(store: Path) -> None:
    site = {"spans": [{"name": "all", "kind": "state", "start": 0, "stop": 1}]}
    edit_root(store, lambda root: root.update(sites=[{"name": f"site{i}", **site} for i in range(100)]))


SITE = ("sites", 0)
ROOT_CASES = [
    Case("root: a FIFO", _instead(os.mkfifo), REFUSED + r"its zarr\.json: it is a FIFO and no regular file"),
    Case("root: a device", _instead(lambda root: root.symlink_to("/dev/zero")), REFUSED + "link that leads out"),
    Case("root: a link out of the store", _instead(_outside), REFUSED + "it is a link that leads out of the store"),
    Case("root: a terabyte", _instead(_sparse), REFUSED + r"1,000,000,000,000 bytes; expected at most 4,000,000"),
    Case("root: 50 MB", _set("provenance", "x", "y" * 50_000_000), REFUSED + r"bytes; expected at most 4,000,000"),
    Case("root: deep lists", _instead(lambda root: root.write_text("[" * 1_000_000)), REFUSED + "nested more than"),
    Case("root: many lists", _instead(lambda root: root.write_text(f"[{'[],' * 1_200_000}1]")), REFUSED + "lists"),
    Case("root: 5,000 digits", _raw('"seed": 0', '"seed": ' + "9" * 5000), REFUSED + "64 bits"),
    Case("root: half a surrogate", _raw('"suite": "made_up', r'"suite": "\ud800'), REFUSED + "surrogate"),
    Case("root: no sites", _set("sites", []), REFUSED + "The number of sites of the run is 0; expected 1 to 64"),
    Case("root: 100 sites", _many_sites, REFUSED + "The number of sites of the run is 100; expected 1 to 64"),
    Case("root: 30,000 spans", _set(*SITE, "spans", _spans(30_000)), REFUSED + "The number of spans .* is 30,000"),
    Case("root: 10^15 keys", _set(*SITE, "spans", -1, "stop", 10**15), REFUSED + "The number of keys of site 'joint'"),
    Case("root: spans on one another", _set(*SITE, "spans", 1, "start", 0), REFUSED + "Span .* the next free key is"),
    Case("root: a grid of 10^9 rows", _far, REFUSED + "The number of rows of a patch grid is 1,000,000,000"),
    Case("root: 10^9 heads", _set(*SITE, "heads", 10**9), REFUSED + "The number of heads of site 'joint'"),
    Case("root: 10^12 queries", _set("recording", "num_action_queries", 10**12), REFUSED + "The number of action quer"),
    Case(
        "root: half a million layers",
        _set("recording", "layers", list(range(500_000))),
        REFUSED + "The number of recorded layers is 500,000; expected 1 to 10,000",
    ),
    Case("root: a policy of 10^12 layers", _set("policy", "num_layers", 10**12), REFUSED + "The policy's num_layers"),
    Case("root: a list as a name", _set("policy", "name", [["x"] * 1000] * 100), REFUSED + r"\$\.policy\.name: "),
]
