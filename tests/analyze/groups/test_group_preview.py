"""What `vla-attention groups` says of a grouping, against counts made by hand from the tokens."""

from __future__ import annotations

import numpy as np
import polars as pl
import pytest

from tests.kit.bowl_scene import bowl_coverage, write_bowl_store
from tests.kit.questions import question_about
from vla_attention.analyze.__main__ import main
from vla_attention.analyze.groups.group_preview import GroupPreview, preview_groups


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    return write_bowl_store(tmp_path_factory.mktemp("groups") / "a.zarr")


def preview_of(path, **settings) -> GroupPreview:
    return preview_groups(question_about(path, **settings))


def totals(preview: GroupPreview) -> dict[str, tuple[float, float]]:
    rows = preview.groups.filter(pl.col("span").is_null())
    return {row["group"]: (round(row["keys_min"], 4), round(row["keys_max"], 4)) for row in rows.iter_rows(named=True)}


def test_keys_are_the_lowest_and_highest_numbers_over_replans(store):
    preview = preview_of(store, groups=("bowl=object:akita_black_bowl_1", "state=role:state", "noun=word:bowl"))
    bowl = sum(area[:, :, 0].sum(axis=1) for area in bowl_coverage(4, 16).values())
    assert totals(preview)["bowl"] == (bowl.min(), bowl.max()) == (6.5, 6.5)
    assert totals(preview)["state"] == (1, 3)
    assert totals(preview)["noun"] == (2, 2)
    # The rest is what is left of 540 keys at each replan.
    assert totals(preview)["rest"] == (540 - 6.5 - 3 - 2, 540 - 6.5 - 1 - 2)


def test_spans_and_roles_of_a_group_add_up_to_it(store):
    table = preview_groups(question_about(store, grouping="default")).groups
    parts = table.filter(pl.col("span").is_not_null()).group_by("group").agg(pl.col("keys_mean").sum())
    whole = table.filter(pl.col("span").is_null()).join(parts, on="group", suffix="_sum")
    np.testing.assert_allclose(whole["keys_mean"], whole["keys_mean_sum"], rtol=1e-6)
    visual = table.filter((pl.col("group") == "visual") & pl.col("span").is_not_null())
    assert visual.select("span", "role", "keys_min", "keys_max", "span_keys").rows() == [
        ("base_0_rgb", "image", 256, 256, 256),
        ("left_wrist_0_rgb", "image", 256, 256, 256),
    ]


def test_words_come_with_their_pieces(store):
    words = preview_of(store, groups=("content=words:content",)).words
    content = words.filter(pl.col("group") == "content").sort("word")
    assert content.select("word", "pieces", "num_pieces", "episodes").rows() == [
        ("black", "black", 1, 4), ("bowl", "bo+wl", 2, 4), ("plate", "plate", 1, 4), ("put", "put", 1, 4),
    ]  # fmt: skip
    assert set(words.filter(pl.col("group") == "rest")["word"]) == {"the", "on"}


def test_the_ratio_of_uniform_attention_is_known_before_any_row_is_read(store, capsys, tmp_path):
    preview = preview_of(store, groups=("a=role:image", "b=role:state"), ratio="a/b")
    assert preview.uniform_ratio == (pytest.approx(512 / 3), 512)
    assert main(["groups", str(store), "--group", "a=role:image", "--group", "b=role:state", "--ratio", "a/b",
                 "--no-plots", "--output", str(tmp_path)]) == 0  # fmt: skip
    assert "uniform attention alone gives 170.7..512." in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--task", "5"], "has no episode of task 5; it has tasks"),
        (["--replan", "4"], "There is no replan 4 in task000_episode000; it has replans 0 to 3"),
        (["--group", "x=word:bowls"], "Did you mean 'bowl'?"),
        (["--group", "x=words:content & words:stop"], "has no key in any of the 4 selected episodes"),
        (["--group", "x=role:image", "--group", "y=camera:base_0_rgb"], "share 256 keys"),
    ],
)
def test_a_mistake_ends_with_one_sentence(store, tmp_path, capsys, arguments, said):
    assert main(["groups", str(store), "--output", str(tmp_path), *arguments]) == 2
    error = capsys.readouterr().err
    assert said in error
    assert "Traceback" not in error
