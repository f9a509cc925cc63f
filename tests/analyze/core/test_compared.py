"""What is compared of heads, against loops over raw arrays; and which episodes have no partner."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import polars as pl
import pytest
import zarr

from tests.kit.questions import question_about
from tests.kit.raw_rows import probabilities
from tests.kit.stores import StoreSpec, write_store
from vla_attention.analyze.core.compared import Compared, RunValues
from vla_attention.analyze.core.runs import Run
from vla_attention.schemas.groupings.grouping import Grouping, Ratio
from vla_attention.schemas.layout import Role

#: Groups that leave keys out, so that a part of the groups' attention is none of the row's.
TWO = Grouping("two", {"seen": ("role:image",), "told": ("role:instruction",)}, Ratio(("seen",), ("told",)))


def test_a_head_has_its_part_of_the_attention_of_the_groups(tmp_path):
    path = write_store(tmp_path / "a.zarr", spec=StoreSpec(tasks=(0,), mantissa_bits=23))
    values = RunValues.of(Run("a", question_about(path, TWO)), ignore_seed=False).values["heads"]
    assert values.height == 2 * 2 * 2
    for row in values.iter_rows(named=True):
        group = zarr.open_group(path, mode="r")[f"episodes/task000_episode{row['episode_index']:03d}"]
        rows, roles = probabilities(group["joint/rows"]), group["joint/key_role"][:]
        rows = rows[:, (0, 2).index(row["layer"]), :, row["head"], 0]
        parts = []
        for replan, row_of_keys in enumerate(rows.mean(axis=1)):
            seen, told = (row_of_keys[roles[replan] == role].sum() for role in (Role.IMAGE, Role.INSTRUCTION))
            parts.append(seen / (seen + told))
        assert row["value"] == pytest.approx(np.mean(parts), rel=1e-6)


def test_episodes_without_a_partner_are_named_with_their_own_run():
    def run(name: str, episodes: list[int]) -> Any:
        frame = pl.DataFrame({"suite": "s", "task_id": 3, "episode_index": episodes})
        return SimpleNamespace(run=SimpleNamespace(name=name), episodes=frame)

    pairs = pl.DataFrame({"suite": "s", "task_id": 3, "episode_first": [0, 1], "episode_other": [5, 6]})
    found = Compared(run("a", [0, 1, 2]), run("b", [2, 5, 6, 7]), pairs, {}, {}).alone()
    assert found.select("run", "compared_with", "episode_index").rows() == [("a", "b", 2), ("b", "a", 2), ("b", "a", 7)]
