"""Rows as the analysis gets them: against the raw arrays and row sums, whole."""

import re
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
import pytest
import zarr

from tests.kit.raw_rows import probabilities, put_probabilities
from tests.kit.stores import reseal, write_store
from vla_attention.analyze.__main__ import main
from vla_attention.analyze.stores.rows import layer_rows
from vla_attention.analyze.stores.selection import select
from vla_attention.schemas.groupings.vocabulary import EpisodeTokens
from vla_attention.schemas.precision import as_read
from vla_attention.schemas.stores.content_rules import add_up, row_sum_bound
from vla_attention.schemas.stores.reader import open_store
from vla_attention.schemas.stores.store_format import CorruptEpisode


def raw_rows(path: Path) -> np.ndarray:
    return probabilities(zarr.open_array(path / "episodes/task000_episode000/joint/rows", mode="r"))


@pytest.mark.parametrize("queries", ["mean", "all"])
@pytest.mark.parametrize("heads", [None, [3, 1]])
@pytest.mark.parametrize("per_head", [True, False])
def test_rows_are_means_of_the_stored_ones(tmp_path, queries, heads, per_head):
    path = write_store(tmp_path / "a.zarr", tasks=(0,), episodes=1, replans=11, heads=(0, 1, 3), queries=queries)
    store = open_store(path)
    selection = select(store.attributes, layers=[2, 0], heads=heads, per_head=per_head)
    raw = raw_rows(path)
    seen = []
    for part in layer_rows(store.attributes, store.episodes[0], selection, "joint"):
        expected = raw[:, selection.layers[part.layer], selection.denoise[part.denoise]][:, list(selection.heads)]
        expected = expected.mean(axis=2) if queries == "all" else expected[:, :, 0]
        if not per_head:
            expected = expected.mean(axis=1, keepdims=True)
        np.testing.assert_allclose(part.rows, expected, rtol=5e-7)
        seen.append((part.layer, part.denoise))
    assert seen == [(0, 0), (0, 1), (1, 0), (1, 1)]


@pytest.mark.parametrize("per_head", [True, False])
@pytest.mark.parametrize("queries", ["mean", "all"])
def test_one_missing_value_in_one_head_is_an_error(tmp_path, per_head, queries):
    path = write_store(tmp_path / "a.zarr", tasks=(0,), episodes=1, replans=11, queries=queries)
    folder = path / "episodes/task000_episode000"
    rows = zarr.open_array(folder / "joint/rows", mode="r+")
    rows[7, 1, 1, 1, 0, 5] = np.nan
    reseal(folder)
    store = open_store(path)
    selection = select(store.attributes, per_head=per_head)
    with pytest.raises(CorruptEpisode, match=r"joint/rows .*task000_episode000"):
        list(layer_rows(store.attributes, store.episodes[0], selection, "joint"))
    others = select(store.attributes, layers=[0], per_head=per_head)
    assert len(list(layer_rows(store.attributes, store.episodes[0], others, "joint"))) == 2


def with_other_rows(path: Path, change: Callable[[np.ndarray], object], **fields: Any) -> Path:
    """A store in which somebody changed the rows of the first episode, and sealed it again."""
    write_store(path, tasks=(0,), episodes=2, replans=11, heads=(0, 1, 3), layers=(0, 2), **fields)
    folder = path / "episodes/task000_episode000"
    rows = zarr.open_array(folder / "joint/rows", mode="r+")
    values = probabilities(rows)
    change(values)
    put_probabilities(rows, values)
    reseal(folder)
    return path


def one_row(values: np.ndarray) -> None:
    values[7, 1, 0, 2] *= 1.01


@pytest.mark.parametrize("per_head", [True, False])
@pytest.mark.parametrize("queries", ["mean", "all"])
def test_a_row_of_another_sum_is_refused_by_its_place(tmp_path, queries, per_head):
    store = open_store(with_other_rows(tmp_path / "a.zarr", one_row, queries=queries))
    selection = select(store.attributes, heads=[1, 3], per_head=per_head)
    with pytest.raises(CorruptEpisode) as caught:
        list(layer_rows(store.attributes, store.episodes[0], selection, "joint"))
    assert re.search(
        r"task000_episode000 .*joint/rows .*0\.0(1|099) .*0\.0005, at replan 7, denoise step 0, layer 2, head 3"
        r"(, query 0, .* 3 of 99 .*)?\.$",
        str(caught.value),
    )
    for layers, denoise in (([0], None), ([2], ["last"])):
        others = select(store.attributes, layers=layers, denoise=denoise, per_head=per_head)
        assert list(layer_rows(store.attributes, store.episodes[0], others, "joint"))


def test_commands_end_so_or_leave_the_episode_out(tmp_path, capsys):
    path = with_other_rows(tmp_path / "a.zarr", one_row)
    corner = ["--group", "corner=patch:base_0_rgb[0:1,0:1]"]
    asked: list[list[str]] = [[str(path), *corner], *([name, str(path)] for name in ("words", "objects"))]
    for words in asked:
        out = str(tmp_path / f"out{len(words[0])}")
        words += ["--no-plots", "--no-cache", "--output", out]
        assert main(words) == 2, words
        said = capsys.readouterr().err
        assert re.search("task000_episode000 .*joint/rows", said)
        assert said.count("\n") == 1
    assert main([*asked[0], "--skip-corrupt"]) == 0
    assert "task000_episode000" in capsys.readouterr().out
    assert pl.read_parquet(tmp_path / f"out{len(str(path))}/episodes.parquet")["episode_index"].unique().to_list() == [
        1
    ]


@pytest.mark.parametrize(
    ("bits", "value", "said"),
    [
        *((23, value, r"replan 3, denoise step 9, layer 0, head 0") for value in (np.inf, 1e38, -0.5)),
        *((10, value, "joint/rows .*no probability") for value in (np.inf, np.nan, -0.5, -(2.0**-39), 1.99)),
        (10, 1.989, r"replan 3, denoise step 9, layer 0, head 0"),
    ],
)
def test_numbers_that_no_row_has_are_refused_without_a_warning(tmp_path, bits, value, said):
    def change(values: np.ndarray) -> None:
        values[3, 0, 1, 0, 0, 4:] = value

    store = open_store(with_other_rows(tmp_path / "a.zarr", change, mantissa_bits=bits))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with pytest.raises(CorruptEpisode, match=said):
            list(layer_rows(store.attributes, store.episodes[0], select(store.attributes), "joint"))


@pytest.mark.parametrize("bits", [1, 4, 10, 23])
@pytest.mark.parametrize("keys", [39, 978, 5000])
def test_what_is_quickly_held_to_add_up_does(bits, keys):
    generator = np.random.default_rng(bits)
    rows = generator.random((200, keys)).astype(np.float32) ** 8
    rows /= rows.sum(axis=1, keepdims=True)
    sums = rows.sum(axis=1, dtype=np.float64).astype(np.float32)
    rounded = as_read(rows, bits)
    assert add_up(rounded, sums, bits)
    bound = row_sum_bound(bits)
    for share, expected in ((0.98, True), (1.02, False)):
        exact = rows * np.float32(1 + share * bound)
        # Near the bound float32 may say no: `row_problems` then says what is right. A yes is right.
        assert add_up(exact, sums, bits) <= expected
        assert add_up(exact, sums, bits) == expected or bound < 1e-4
    assert not add_up(np.where(np.arange(keys) == 3, np.float32(np.nan), rounded), sums, bits)


def tiny(_task: int, _episode: int, _tokens: EpisodeTokens, rows: np.ndarray) -> np.ndarray:
    """Every other key gets less than float16 of p x 2^15 holds with ten bits, the others share the rest."""
    small = rows.copy()
    small[..., ::2] *= np.float32(2.0**-32)
    return small / small.sum(axis=-1, keepdims=True)


def test_tiny_probabilities_do_not_depend_on_how_the_processor_takes_subnormal_numbers(tmp_path):
    torch = pytest.importorskip("torch")
    store = open_store(write_store(tmp_path / "a.zarr", tasks=(0,), episodes=1, plant_rows=tiny))
    selection = select(store.attributes)

    def read() -> list[np.ndarray]:
        return [part.rows.copy() for part in layer_rows(store.attributes, store.episodes[0], selection, "joint")]

    expected = read()
    assert np.mean([((rows > 0) & (rows < 2.0**-29)).mean() for rows in expected]) > 0.3
    assert torch.set_flush_denormal(True)
    try:
        found = read()
    finally:
        torch.set_flush_denormal(False)
    assert all(map(np.array_equal, found, expected))


@pytest.mark.parametrize(("bits", "names"), [(10, ["'bowl'"]), (23, [])])
def test_a_note_names_what_rounding_may_have_changed(tmp_path, capsys, bits, names):
    def hardly_read(_task: int, _episode: int, tokens: EpisodeTokens, rows: np.ndarray) -> np.ndarray:
        small = rows.copy()
        for replan, words in enumerate(tokens.words[prompt] for prompt in tokens.prompt_index):
            for word in words:
                small[replan, ..., list(word.keys)] *= np.float32(1e-9 if word.text == "bowl" else 1)
        return small / small.sum(axis=-1, keepdims=True)

    path = write_store(tmp_path / "a.zarr", tasks=(0,), mantissa_bits=bits, plant_rows=hardly_read)
    assert main(["words", str(path), "--no-plots", "--no-cache", "--output", str(tmp_path / "out")]) == 0
    said = capsys.readouterr().err
    assert ("--precision exact" in said) is bool(names)
    assert all(name.strip("'") in said for name in names)
    assert "plate" not in said
