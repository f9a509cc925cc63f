"""What `vla-attention groups` says of a grouping, against counts made by hand from the tokens."""

from __future__ import annotations

import numpy as np
import polars as pl
import pytest

from tests.kit.bowl_scene import bowl_coverage, write_bowl_store
from tests.kit.questions import question_about
from vla_attention.analyze.__main__ import main
from vla_attention.analyze.groups.group_preview import UNTAKEN, GroupPreview, preview_groups
from vla_attention.schemas.groupings.grouping import GroupingError
from vla_attention.testing.stores import write_store


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


@pytest.mark.drawn
def test_overlaps_and_keys_without_a_group_are_printed(store, tmp_path, capsys):
    (tmp_path / "g.toml").write_text(
        'overlap = true\n[groups]\nlooks = "role:image"\nbowl = "object:akita_black_bowl_1"\nnoun = "word:bowl"\n'
    )
    preview = preview_of(store, grouping=str(tmp_path / "g.toml"))
    assert preview.overlaps.rows() == [("looks", "bowl", 6.5, 6.5, 6.5)]
    untaken = preview.groups.filter(pl.col("group") == UNTAKEN)
    assert untaken.row(0, named=True)["keys_mean"] == 540 - 512 - 2
    assert {(row["span"], row["role"]) for row in untaken.slice(1).iter_rows(named=True)} == {
        ("prompt", "bos"), ("prompt", "state"), ("prompt", "instruction"), ("prompt", "padding"), ("actions", "action"),
    }  # fmt: skip
    arguments = [
        "groups",
        str(store),
        "--grouping",
        str(tmp_path / "g.toml"),
        "--output",
        str(tmp_path / "out"),
        "--pdf",
    ]
    assert main(arguments) == 0
    printed = capsys.readouterr().out
    assert "Groups 'looks' and 'bowl' share 6.500 keys." in printed
    assert "No group takes 26 keys" in printed
    assert "bowl (bo+wl)" in printed
    assert {path.name for path in (tmp_path / "out").iterdir()} == {
        *(f"{name}.parquet" for name in ("groups", "group_words", "group_overlaps")),
        *(f"group_patches.{kind}" for kind in ("png", "pdf", "csv")),
    }  # fmt: skip


def test_the_picture_shows_the_chosen_replan(store, tmp_path):
    patches = []
    for replan in (0, 2):
        folder = tmp_path / str(replan)
        arguments = ["--task", "1", "--episode", "1", "--replan", str(replan), "--output", str(folder)]
        assert main(["groups", str(store), "--group", "bowl=object:akita_black_bowl_1", *arguments]) == 0
        data = pl.read_csv(folder / "group_patches.csv")
        bowl = data.filter((pl.col("group") == "bowl") & (pl.col("span") == "base_0_rgb"))
        area = bowl_coverage(4, 16)["base_0_rgb"][replan, :, 0].reshape(16, 16)
        assert {(row, column): weight for row, column, weight in bowl.select("row", "column", "weight").rows()} == {
            (int(row), int(column)): area[row, column] for row, column in zip(*np.nonzero(area), strict=True)
        }
        patches.append(set(bowl["column"]))
    assert patches == [{1, 2}, {3, 4}]


@pytest.mark.drawn
def test_a_store_without_frames_is_drawn_too(tmp_path):
    path = write_bowl_store(tmp_path / "bare.zarr", frames=False, tasks=(0,), episodes=1)
    assert main(["groups", str(path), "--grouping", "objects", "--output", str(tmp_path / "out")]) == 0
    assert (tmp_path / "out" / "group_patches.png").stat().st_size > 10_000


def test_the_ratio_of_uniform_attention_is_known_before_any_row_is_read(store, capsys, tmp_path):
    preview = preview_of(store, groups=("a=role:image", "b=role:state"), ratio="a/b")
    assert preview.uniform_ratio == (pytest.approx(512 / 3), 512)
    assert main(["groups", str(store), "--group", "a=role:image", "--group", "b=role:state", "--ratio", "a/b",
                 "--no-plots", "--output", str(tmp_path)]) == 0  # fmt: skip
    assert "uniform attention alone gives 170.7..512." in capsys.readouterr().out


def test_words_of_one_task_are_no_mistake_in_a_store_of_several(tmp_path):
    path = write_store(tmp_path / "tasks.zarr", tasks=(0, 1), episodes=1)
    assert totals(preview_of(path, groups=("noun=word:drawer",)))["noun"] == (0, 1)


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


def test_errors_of_the_grouping_reach_python_callers(store):
    with pytest.raises(GroupingError, match="share"):
        preview_of(store, groups=("x=role:image", "y=camera:base_0_rgb"))
