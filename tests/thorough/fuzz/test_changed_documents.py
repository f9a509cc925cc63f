"""Files of stores and data sets, groupings and results that are changed at random places: taken, or refused."""

from __future__ import annotations

import copy
import json
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tests.kit.examples import examples
from tests.kit.strategies import layouts
from tests.thorough.fuzz_targets import run, seeds
from vla_attention.schemas.jsonable import to_json

#: Parsers of JSON.
DOCUMENTS = ("roots", "seals", "attributes", "arrays", "sharded_arrays", "results", "data_set_infos")
#: Parsers of other files, which are changed byte by byte.
FILES = ("shards", "episode_lines", "pictures")
NUMBERS = st.sampled_from([0, -1, 1, 2**31, 2**63, 2**64, 10**30, 0.5, -0.0, 1e308])
TEXTS = st.one_of(st.text(max_size=8), st.sampled_from(["", "..", "a/b", "\x1b[2J", "joint", "rows", "float64", "c"]))
VALUES = st.recursive(
    st.one_of(st.none(), st.booleans(), NUMBERS, st.integers(), TEXTS),
    lambda inner: st.one_of(st.lists(inner, max_size=3), st.dictionaries(TEXTS, inner, max_size=3)),
    max_leaves=6,
)


def places(value: Any, path: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    """The paths of all values in a document."""
    inner = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    return [path, *(place for key, item in inner for place in places(item, (*path, key)))]


@st.composite
def changed(draw: st.DrawFn, document: Any) -> Any:
    """The document with one to three values exchanged, removed, repeated or added."""
    document = copy.deepcopy(document)
    for _ in range(draw(st.integers(1, 3))):
        place = draw(st.sampled_from(places(document)))
        if not place:
            return draw(VALUES)
        holder = document
        for key in place[:-1]:
            holder = holder[key]
        what = draw(st.sampled_from(["exchange", "exchange", "remove", "add", "repeat"]))
        if what == "remove":
            del holder[place[-1]]
        elif what == "exchange":
            holder[place[-1]] = draw(VALUES)
        elif isinstance(holder, list):
            holder.append(copy.deepcopy(holder[place[-1]]) if what == "repeat" else draw(VALUES))
        else:
            holder[draw(TEXTS)] = copy.deepcopy(holder[place[-1]]) if what == "repeat" else draw(VALUES)
    return document


ORIGINALS = {name: json.loads(seeds(name)[0]) for name in DOCUMENTS}


@pytest.mark.parametrize("name", DOCUMENTS)
def test_changed_documents_are_taken_or_refused(name):
    @settings(max_examples=examples(25), deadline=None, suppress_health_check=list(HealthCheck))
    @given(changed(ORIGINALS[name]))
    def check(document: Any) -> None:
        run(name, json.dumps(document).encode())

    check()


@settings(max_examples=examples(15), deadline=None, suppress_health_check=list(HealthCheck))
@given(st.data())
def test_roots_with_other_layouts_are_taken_or_refused(data):
    """Any valid layout, and any change of it: what the keys are is the root's word alone."""
    document = copy.deepcopy(ORIGINALS["roots"])
    layout = to_json(data.draw(layouts()))
    document["attributes"]["sites"] = [data.draw(st.one_of(st.just(layout), changed(layout)))]
    run("roots", json.dumps(document).encode())


_NAMED = ["role:image", "camera:base_0_rgb", "word:bowl", 'word:"the bowl"', "span:prompt", "object:plate_1"]
_PLACED = ["*", "keys:0-3", "patch:base_0_rgb[0:1,0:9]"]
_WRONG = ["frame:x", "keys:3-1", "role:", "camera:none", f"keys:{10**20}-1", f"patch:base_0_rgb[0:{10**20},0:1]"]
ATOMS = st.sampled_from([*_NAMED, *_PLACED, *_WRONG])
SELECTORS = st.recursive(
    ATOMS,
    lambda inner: st.one_of(
        st.tuples(inner, st.sampled_from([" | ", " & ", " - ", " -", " ", "&&"]), inner).map("".join),
        inner.map(lambda one: f"({one})"),
        inner.map(lambda one: f"({one}"),
    ),
    max_leaves=8,
)


@settings(max_examples=examples(50), deadline=None, suppress_health_check=list(HealthCheck))
@given(selector=st.one_of(SELECTORS, st.text(max_size=20)))
def test_selectors_are_taken_or_refused(selector):
    run("selectors", selector.encode("utf-8", "surrogatepass"))


@settings(max_examples=examples(30), deadline=None, suppress_health_check=list(HealthCheck))
@given(data=st.data())
def test_grouping_files_are_taken_or_refused(data):
    names = st.sampled_from(["a", "b", "rest", "visual", "linguistic", "ratio", "", "ü", "a\n", "a" * 300])
    groups = data.draw(st.dictionaries(names, st.one_of(SELECTORS, st.lists(SELECTORS, max_size=3)), max_size=4))
    fields = {
        "name": data.draw(VALUES),
        "overlap": data.draw(st.one_of(st.booleans(), VALUES)),
        "allow_empty": data.draw(st.lists(names, max_size=2)),
    }
    chosen = data.draw(st.lists(st.sampled_from(sorted(fields)), unique=True))
    lines = [f"{name} = {toml(fields[name])}" for name in chosen]
    lines += ["[groups]", *(f"{toml(name)} = {toml(selectors)}" for name, selectors in groups.items())]
    if data.draw(st.booleans()):
        sides = [data.draw(st.lists(names, max_size=2)) for _ in range(2)]
        lines += ["[ratio]", f"numerator = {toml(sides[0])}", f"denominator = {toml(sides[1])}"]
    run("groupings", "\n".join(lines).encode("utf-8", "surrogatepass"))


def toml(value: Any) -> str:
    """A value as TOML has it, near enough: JSON with `=` in tables."""
    if isinstance(value, dict):
        return "{" + ", ".join(f"{json.dumps(key)} = {toml(item)}" for key, item in value.items()) + "}"
    if isinstance(value, list):
        return "[" + ", ".join(map(toml, value)) + "]"
    return "''" if value is None else json.dumps(value)


@pytest.mark.parametrize("target", FILES)
def test_files_with_changed_bytes_are_taken_or_refused(target):
    original = seeds(target)[0]

    @settings(max_examples=examples(40), deadline=None, suppress_health_check=list(HealthCheck))
    @given(st.lists(st.tuples(st.integers(0, len(original) - 1), st.integers(0, 255)), max_size=6), st.integers(0, 40))
    def check(changes: list[tuple[int, int]], cut: int) -> None:
        content = bytearray(original)
        for place, value in changes:
            content[place] = value
        run(target, bytes(content[cut:]))

    check()
