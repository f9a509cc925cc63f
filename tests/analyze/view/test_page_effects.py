"""Effects on the page are those of `vla-attention effects`: by item, reader and replan, in the same units and words."""

from __future__ import annotations

import json
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import vla_attention as va
from tests.analyze.view.page_answers import PageQuestion, needs_node, page_answers
from tests.kit.golden_stores import golden_store
from tests.kit.http_ranges import serve
from vla_attention.analyze.core.action_changes import units_of_recorded
from vla_attention.analyze.view.summary_process import summary_parts
from vla_attention.schemas.stores.reader import open_store

pytestmark = needs_node
#: Changes are float32, and Python adds them to the actions and takes them off again.
CLOSE = 1e-9


def answers_of(stores: Sequence[Path], **given: Any) -> list[Any]:
    """What the page shows of each store's first episode; `units`, if given, replace those that Python computes."""
    folder = stores[0].parent
    names = []
    for store in stores:
        if "units" in given:
            of_store = {"effect_units": given["units"]}
        else:
            of_store = next((part for part in summary_parts(open_store(store)) if "effect_units" in part), {})
        names.append(f"{store.name}.summary.json")
        (folder / names[-1]).write_text(json.dumps({"complete": True, "episodes": [], **of_store}))
    with serve(folder) as served:
        questions = [
            PageQuestion(f"{served.url}/", f"{store.name}/", summary=f"{served.url}/{name}")
            for store, name in zip(stores, names, strict=True)
        ]
        return page_answers(folder, questions)


@pytest.fixture(scope="module")
def golden(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The golden store with effects of words and objects for all readers; one dimension of it is mostly noise."""
    folder = tmp_path_factory.mktemp("golden")
    shutil.copytree(golden_store("effects"), folder / "effects.zarr")
    return folder / "effects.zarr"


@pytest.fixture(scope="module")
def found(golden: Path) -> list[Any]:
    """The page's effects of the golden store, and of a store without effects."""
    shutil.copytree(golden_store("joint"), golden.with_name("joint.zarr"))
    return [answer["effects"] for answer in answers_of([golden, golden.with_name("joint.zarr")])]


def on_the_page(condition: str) -> str:
    """The page's name of an item, which it takes from that of a condition."""
    kind, _, name = (stem := condition.removeprefix("without_").split("_queries_")[0]).partition("_")
    return f"'{name}'" if kind == "word" else name if kind in ("camera", "object") else stem


def test_means_of_the_episode_are_pythons(found, golden):
    table = va.open(golden).effects()["effects_episodes"].filter(task_id=0, episode_index=0)
    effect = {row["condition"]: row for row in table.iter_rows(named=True)}
    without = table.filter(kind="without").rows(named=True)
    for row in without:
        mean, low, high, count = found[0]["items"][on_the_page(row["condition"])][row["reader"]]["mean"]
        assert mean == pytest.approx(row["effect"], rel=CLOSE), row["condition"]
        assert low <= mean <= high
        assert count == row["num_replans"]
    assert len(without) == sum(len(readers) for readers in found[0]["items"].values()) > 20
    assert found[0]["noise"]["mean"][0] == pytest.approx(effect["noise"]["effect"], rel=CLOSE)
    random = [row for name, row in effect.items() if name.startswith("random_") and "_queries_" not in name]
    shown = sorted(readers["direct"]["mean"][0] for readers in found[0]["random"].values())
    np.testing.assert_allclose(shown, sorted(row["effect"] for row in random), rtol=CLOSE)


def test_each_replan_has_its_own_from_the_raw_arrays(found, golden):
    store = open_store(golden)
    units = units_of_recorded(store)
    assert not units.used.all()  # else the test would not see that a dimension is left out
    attributes = store.episodes[0].attributes
    effects, change = attributes.effects, store.episodes[0].read("effects/change")
    steps = np.minimum(np.diff([*attributes.env_step, attributes.num_steps + store.attributes.protocol.wait_steps]), 5)
    names = [condition.name for condition in effects.conditions]
    for name, item, reader in (
        ("without_state", "state", "direct"),
        ("without_word_lift_queries_all", "'lift'", "total"),
    ):
        shown = [*found[0]["items"][item][reader]["replans"]]
        for entry, replan in enumerate(effects.replan):
            if names[effects.condition[entry]] == name:
                squares = [
                    (float(value) * effects.units[i] / units.spread[i]) ** 2
                    for step in range(steps[replan])
                    for i, value in enumerate(change[entry, step])
                    if units.used[i]
                ]
                assert shown[replan] == pytest.approx(np.sqrt(np.mean(squares)), rel=CLOSE)
                shown[replan] = None
        assert all(value in (None, "NaN") for value in shown)
