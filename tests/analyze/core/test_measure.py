"""Measured items and tables of steps against independent arithmetic from the raw Zarr arrays of random stores."""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np
import polars as pl
import pytest
import zarr
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st
from polars.testing import assert_frame_equal

from tests.kit.examples import examples
from tests.kit.made_up_steps import steps_of
from tests.kit.questions import question_about
from tests.kit.raw_rows import probabilities
from tests.kit.stores import StoreSpec, root_attributes, write_store
from tests.kit.strategies import episode_tokens, groupings
from vla_attention.analyze.commands.analyze import analyze
from vla_attention.analyze.core.levels import levels_of
from vla_attention.analyze.measures.selected import load_tokens, vocabulary_of
from vla_attention.analyze.stores.selection import select
from vla_attention.schemas.errors import BadArgument
from vla_attention.schemas.groupings.builtin_groupings import default
from vla_attention.schemas.groupings.grouping import Grouping, Ratio
from vla_attention.schemas.groupings.resolve import EmptyGroup, resolve
from vla_attention.schemas.precision import mass_error_bound
from vla_attention.schemas.stores.reader import StoredEpisode, open_store
from vla_attention.schemas.stores.store_format import StoreError

#: Every example writes a store (and flushes it to disk): shrinking one would take minutes.
QUICK = settings(
    max_examples=examples(8),
    phases=[Phase.explicit, Phase.generate],
    deadline=None,
    suppress_health_check=[HealthCheck.too_slow],
)


def table_of(path: Path, grouping: Grouping, heads: bool = False, **selected) -> pl.DataFrame:
    return steps_of(levels_of(question_about(path, grouping, **selected), heads)).flat


@QUICK
@given(data=st.data())
def test_masses_equal_sums_over_raw_rows_and_add_up_to_the_row_sums(data):
    tokens = data.draw(episode_tokens())
    grouping = data.draw(groupings(tokens))
    bits = data.draw(st.sampled_from([4, 10, 23]))
    queries = data.draw(st.sampled_from(["mean", "all"]))
    per_head = data.draw(st.booleans())
    with tempfile.TemporaryDirectory() as folder:
        path = write_store(
            Path(folder) / "a.zarr", tokens=tokens, tasks=(0,), episodes=1, mantissa_bits=bits, queries=queries
        )
        table = table_of(path, grouping, per_head)
        raw = zarr.open_group(path / "episodes/task000_episode000", mode="r")["joint"]
        rows, sums = probabilities(raw["rows"]).astype(np.float64), raw["atoms"][..., -1].astype(np.float64)
    rows, sums = rows.mean(axis=4), sums.mean(axis=4)
    if not per_head:
        rows, sums = rows.mean(axis=3, keepdims=True), sums.mean(axis=3, keepdims=True)
    weights = np.broadcast_to(resolve(grouping, tokens).weights, (rows.shape[0], rows.shape[-1], len(grouping.names)))
    by_hand = np.einsum("rldhk,rkg->rldhg", rows, weights)
    # Masses that come from the exact atoms and not from rows differ by what rounding the rows can do, and no more.
    bound = mass_error_bound(bits) + 1e-5
    total = np.zeros(rows.shape[:-1])
    for i, name in enumerate(grouping.names):
        mass = table[f"{name}_mass"].to_numpy().reshape(rows.shape[:-1])
        np.testing.assert_allclose(mass, by_hand[..., i], rtol=bound, atol=1e-9)
        np.testing.assert_allclose(table[f"{name}_keys"].to_numpy()[0], weights[0, :, i].sum(), rtol=1e-5)
        total += mass
    np.testing.assert_allclose(total, sums, rtol=bound)
    np.testing.assert_allclose(table["row_sum"].to_numpy().reshape(sums.shape), sums, rtol=1e-6)


@QUICK
@given(data=st.data())
def test_fractions_lifts_and_ratios_follow_from_masses_and_counts(data):
    tokens = data.draw(episode_tokens())
    with tempfile.TemporaryDirectory() as folder:
        path = write_store(Path(folder) / "a.zarr", tokens=tokens, tasks=(0,), episodes=1)
        store = open_store(path)
        grouping = default(vocabulary_of(load_tokens([(store, store.episodes[0])], "joint")))
        table = table_of(path, grouping)
    for row in table.iter_rows(named=True):
        total = sum(row[f"{name}_mass"] for name in grouping.names)
        for name in grouping.names:
            assert row[f"{name}_fraction"] == pytest.approx(row[f"{name}_mass"] / total)
            if row[f"{name}_mass"]:  # keys that no query sees have none, and no lift
                density = row[f"{name}_mass"] / row[f"{name}_keys"]
                assert row[f"{name}_lift"] == pytest.approx(density / (row["row_sum"] / row["num_valid"]))
            else:
                assert row[f"{name}_lift"] is None
        assert row["ratio"] == pytest.approx(row["visual_mass"] / row["linguistic_mass"])
        assert row["uniform_ratio"] == pytest.approx(row["visual_keys"] / row["linguistic_keys"])
        assert row["ratio_lift"] == pytest.approx(row["visual_lift"] / row["linguistic_lift"])
        assert row["log2_ratio"] == pytest.approx(np.log2(row["ratio"]))


def test_a_selection_of_layers_steps_and_heads_takes_exactly_those(tmp_path):
    path = write_store(tmp_path / "a.zarr", heads=(1, 3), layers=(0, 2, 3), denoise_steps=(0, 4, 9))
    grouping = Grouping("g", {"words": ("word:the",), "rest": ("*",)})
    whole = table_of(path, grouping, True)
    part = steps_of(
        levels_of(question_about(path, grouping, layers=(3, 0), denoise=("last",), heads=(3,)), heads=True)
    ).flat
    assert part["block"].unique(maintain_order=True).to_list() == [3, 0]
    expected = whole.filter(pl.col("block").is_in([3, 0]), pl.col("denoise_step") == 9, pl.col("head") == 3)
    keys = ["task_id", "episode_index", "replan", "block"]
    assert_frame_equal(part.sort(keys), expected.sort(keys), rel_tol=1e-5)


def test_a_ratio_without_denominator_mass_is_infinite_and_without_any_mass_undefined(tmp_path):
    path = write_store(tmp_path / "a.zarr")
    masked = next(span.name for span in open_store(path).attributes.sites[0].spans if span.name.startswith("right"))
    groups = {"seen": ("role:image",), "blind": (f"span:{masked}",), "rest": ("*",)}
    infinite = table_of(path, Grouping("g", groups, ratio=Ratio(("seen",), ("blind",))))
    assert infinite["ratio"].is_infinite().all()
    undefined = table_of(path, Grouping("g", groups, ratio=Ratio(("blind",), ("blind",))))
    assert undefined["ratio"].is_null().all()


def test_a_word_of_one_task_only_gives_empty_groups_elsewhere(tmp_path):
    path = write_store(tmp_path / "a.zarr", tasks=(0, 1))
    table = table_of(path, Grouping("g", {"bowl": ("word:bowl",), "rest": ("*",)}))
    counts = dict(table.group_by("task_id").agg(pl.col("bowl_keys").sum()).iter_rows())
    assert counts[0] > 0
    assert counts[1] == 0
    with pytest.raises(EmptyGroup, match=r"'bowl'.* 4 "):
        table_of(path, Grouping("g", {"bowl": ("word:bowl & role:image",), "rest": ("*",)}))


def test_several_stores_are_analysed_as_one_when_they_fit(tmp_path):
    first = open_store(write_store(tmp_path / "a.zarr", suite="one"))
    second = open_store(write_store(tmp_path / "b.zarr", suite="two"))
    together = analyze(question_about([first, second]))
    assert together["steps"]["suite"].unique().sort().to_list() == ["one", "two"]
    assert "one, two" in together.about[0]
    other = open_store(write_store(tmp_path / "c.zarr", suite="three", layers=(1,)))
    with pytest.raises(StoreError, match=r"recording|layers"):
        question_about([first, other])


def test_call_numbers_are_translated_and_kept_as_labels():
    from msgspec.structs import replace

    root = root_attributes(StoreSpec(layers=(7,), layer_labels=(25,), num_layers=18))
    root = replace(root, policy=replace(root.policy, family="pi05"))
    assert select(root).layer_labels == (25,)
    chosen = select(root, layers=[25])
    assert (chosen.blocks, chosen.layer_labels, chosen.layers) == ((7,), (25,), (0,))
    assert "25 = block 7" in (chosen.note or "")
    assert select(root, layers=[7]).layer_labels == (7,)
    for wrong, named in (
        ([8], r"\b8\b"),
        ([36], "18 to 35"),
        ([7, 7], "7, 7"),
    ):
        with pytest.raises(BadArgument, match=named):
            select(root, layers=wrong)


def test_a_group_without_keys_anywhere_is_refused_before_rows_are_read(tmp_path, monkeypatch):
    path = write_store(tmp_path / "a.zarr", tasks=(0, 1), episodes=2)
    monkeypatch.setattr(StoredEpisode, "read_layers", lambda *_: pytest.fail("rows were read"))
    question = question_about(path, groups=("a=word:the & camera:base_0_rgb", "b=word:the"))
    with pytest.raises(EmptyGroup, match=r"'a' .* 4 "):
        levels_of(question)
