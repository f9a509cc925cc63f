"""A published checkpoint folder with small random weights: the published command, and faults of its files."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import polars as pl
import pytest
import torch
import zarr

from tests.end_to_end.written_tables import written_steps
from tests.kit.cosmos_checkpoint import write_dummy_folder
from tests.kit.raw_rows import probabilities
from vla_attention.analyze.__main__ import main as analyze
from vla_attention.capture.__main__ import main as capture
from vla_attention.capture.environments.suites import find_suite, list_tasks
from vla_attention.capture.policies.cosmos.config import CosmosConfig, DitConfig, VaeConfig
from vla_attention.capture.policies.cosmos.embedded import DUMMY_CONFIG

#: The published policy's 28 blocks, nine latent frames of 14 x 14 tokens, 512 text positions and five calls; narrow
#: inside.
PUBLISHED_SHAPE = replace(
    CosmosConfig(),
    dit=DitConfig(width=24, num_blocks=28, num_heads=2, mlp_dim=48, text_dim=24, adaln_dim=8),
    vae=VaeConfig(base_dim=4),
)
#: The options of the published command.
PUBLISHED_OPTIONS = [
    *("--layers", "25", "26", "27", "--query-frame", "action"),
    *("--visual-frame", "curr_last", "--text-frame", "frame0"),
]
NUM_QUERIES, NUM_KEYS = 196, 1764
#: One built-in task, one replan.
SHORT = ["--task-id", "1", "--num-episodes", "1", "--max-steps", "4", "--device", "cpu", "--layers", "1"]


@pytest.fixture(scope="module", autouse=True)
def alone() -> Iterator[None]:
    """No files of this machine's hub cache."""
    pytest.importorskip("diffusers")
    cache = os.environ.get("HF_HUB_CACHE")
    os.environ["HF_HUB_CACHE"] = os.devnull
    yield
    if cache is None:
        del os.environ["HF_HUB_CACHE"]
    else:
        os.environ["HF_HUB_CACHE"] = cache


# The published command in the real LIBERO


@pytest.fixture(scope="module")
def libero_run(libero_assets: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of `--output-dir`: the store, and the results of the proxy."""
    folder = tmp_path_factory.mktemp("published")
    task = list_tasks(find_suite("libero_10"))[0]
    checkpoint = write_dummy_folder(
        folder / "checkpoint", PUBLISHED_SHAPE, [task.instruction], dtype=torch.float32, with_tokenizer=True
    )
    command = ["cosmos", "--ckpt-path", str(checkpoint), "--task-suite", "libero_10", "--num-episodes", "1"]
    few = ["--task-id", "0", "--max-steps", "20", "--libero-assets", str(libero_assets), "--device", "cpu"]
    assert capture([*command, *PUBLISHED_OPTIONS, *few, "--output-dir", str(folder / "results")]) == 0
    return folder / "results"


@pytest.fixture(scope="module")
def libero_store(libero_run: Path) -> Path:
    (store,) = libero_run.glob("*.zarr")
    return store


def rows_of(store: Path, site: str) -> np.ndarray:
    """(replan, layer, denoise, head, query, key) float64."""
    group = zarr.open_group(store / "episodes/task000_episode000", mode="r")
    return probabilities(group[f"{site}/rows"]).astype(np.float64)


@pytest.mark.thorough
@pytest.mark.libero
@pytest.mark.simulator
def test_the_store_has_the_published_sizes_and_both_sites(libero_store):
    assert analyze(["store", "verify", str(libero_store)]) == 0
    # 20 steps, 16 actions a call: two replans; layers 25 to 27; the first and the last of five calls.
    assert rows_of(libero_store, "self").shape == (2, 3, 2, 2, 1, NUM_KEYS)
    assert rows_of(libero_store, "cross").shape == (2, 3, 2, 2, 1, 512)


@pytest.mark.thorough
@pytest.mark.libero
@pytest.mark.simulator
def test_the_results_of_the_command_have_the_published_fields_and_sums(libero_run, libero_store):
    (episode,) = json.loads((libero_run / "attention_ratio_results_libero_10.json").read_text())
    assert list(episode["per_step_ratios"]) == ["layer_25", "layer_26", "layer_27", "layers_avg"]
    rows = rows_of(libero_store, "self")[:, :, -1, :, 0].mean(axis=2)  # the last call, mean over heads
    visual, blank = NUM_QUERIES * rows[..., 588:784].sum(-1), NUM_QUERIES * rows[..., :196].sum(-1)
    for i, layer in enumerate((25, 26, 27)):
        steps = episode["per_step_ratios"][f"layer_{layer}"]
        assert [step["step"] for step in steps] == [10, 26]
        for replan, step in enumerate(steps):
            assert step["visual_mass"] == pytest.approx(visual[replan, i], rel=1e-3)
            assert step["linguistic_mass"] == pytest.approx(blank[replan, i], rel=1e-3)
            assert step["visual_linguistic_ratio"] == pytest.approx(visual[replan, i] / blank[replan, i], rel=2e-3)
            share = visual[replan, i] / (visual[replan, i] + blank[replan, i])
            assert step["visual_fraction"] == pytest.approx(share, rel=2e-3)
            assert step["selected_call_S"] == NUM_KEYS
            assert (step["query_frame"], step["visual_frame"], step["text_frame"]) == ("action", "curr_last", "frame0")


@pytest.mark.thorough
@pytest.mark.libero
@pytest.mark.simulator
def test_default_and_reference_with_pictures(libero_store, tmp_path, capsys):
    for grouping, site in (("default", "self"), ("default", "cross"), ("reference", "self")):
        folder = tmp_path / f"{grouping}_{site}"
        assert analyze([str(libero_store), "--grouping", grouping, "--site", site, "--output", str(folder)]) == 0
        assert {"result.json", "steps.parquet", "attention_fractions.png"} <= {file.name for file in folder.iterdir()}
    assert (tmp_path / "reference_self/ratio_distribution.png").is_file()
    steps = pl.read_parquet(tmp_path / "reference_self/steps.parquet")
    proxy = pl.read_parquet(libero_store.parent / "steps.parquet")
    last = steps.filter(denoise_step=4).sort("replan", "layer")["ratio"]
    np.testing.assert_allclose(last, proxy.sort("replan", "layer")["ratio"], rtol=1e-6)
    cross = written_steps(tmp_path / "default_cross")
    # Padded positions get attention and are no language.
    assert (cross["null_mass"] > 0).all()
    np.testing.assert_allclose(cross["linguistic_mass"] + cross["null_mass"], cross["row_sum"], rtol=1e-3)
    capsys.readouterr()
    assert analyze([str(libero_store), "--grouping", "reference", "--site", "cross", "--output", str(tmp_path)]) == 2
    assert "--site" in capsys.readouterr().err


# Faults of the files: one sentence, exit code 2, and no store


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A checkpoint of test size; its faults are found before its size matters."""
    return write_dummy_folder(tmp_path / "checkpoint", DUMMY_CONFIG, ["stack the red cube"], dtype=torch.float32)


@pytest.mark.simulator
def test_an_instruction_without_embedding_names_the_near_ones(folder, capsys):
    """The error comes at the first replan: the store exists then, without an episode."""
    store = folder.parent / "a.zarr"
    assert capture(["cosmos", "--ckpt-path", str(folder), *SHORT, "--output", str(store)]) == 2
    assert not list((store / "episodes").glob("task*"))
    said = capsys.readouterr().err.strip().splitlines()[-1]
    assert re.search("'stack the red cube on top of the green cube'.*'stack the red cube'", said)


@pytest.mark.thorough
@pytest.mark.simulator
def test_without_t5s_tokenizer_words_cannot_be_selected_and_the_text_as_a_whole_can(tmp_path, capsys):
    task = list_tasks(find_suite("robosuite"))[1]
    folder = write_dummy_folder(tmp_path / "checkpoint", DUMMY_CONFIG, [task.instruction], dtype=torch.float32)
    store = str(tmp_path / "a.zarr")
    assert capture(["cosmos", "--ckpt-path", str(folder), *SHORT, "--output", store]) == 0
    assert "--t5-tokenizer" in capsys.readouterr().err
    asked = [store, "--site", "cross", "--no-plots", "--output", str(tmp_path / "out")]
    assert analyze([*asked, "--group", "cube=word:cube"]) == 2
    assert "--t5-tokenizer" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
    assert analyze([*asked, "--group", "text=role:text"]) == 0
    assert (written_steps(tmp_path / "out")["text_mass"] > 0).all()
