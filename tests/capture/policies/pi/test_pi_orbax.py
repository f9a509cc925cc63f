"""openpi's JAX checkpoints, written by openpi and orbax themselves, read without either."""

import json
import shutil

import numpy as np
import pytest
import torch
from pi_golden import GOLDEN, LARGE_GOLDEN, load_case

from capture.policies.pi.checkpoint import CheckpointMismatch, UnreadableCheckpoint, UnsupportedCheckpoint
from capture.policies.pi.jax_weights import from_jax_flat
from capture.policies.pi.loading import load_pi_model
from capture.policies.pi.orbax import list_leaves, load_openpi_jax, read_leaf
from capture.policies.pi.preprocess import read_norm_stats

pytest.importorskip("tensorstore")
STORED = GOLDEN / "pi0_batch2" / "checkpoint"


@pytest.fixture
def checkpoint(tmp_path):
    folder = tmp_path / "checkpoint"
    shutil.copytree(STORED, folder)
    return folder


@pytest.fixture(scope="module")
def pi0_case():
    return load_case(GOLDEN / "pi0_batch2")


def test_every_leaf_is_bit_identical(pi0_case):
    leaves = list_leaves(STORED / "params")
    assert {leaf.path for leaf in leaves} == set(pi0_case.weights)
    for leaf in leaves:
        np.testing.assert_array_equal(read_leaf(STORED / "params", leaf), pi0_case.weights[leaf.path])


@pytest.mark.parametrize("name", ["pi0_batch2", "pi05_batch2", "pi05_full_layout"])
def test_loaded_model_is_that_of_the_flat_weights(name):
    folder = GOLDEN / name if name == "pi0_batch2" else LARGE_GOLDEN / name
    if not folder.is_dir():
        pytest.skip("this golden checkpoint is not in the repository, and not beside this checkout")
    case = load_case(folder)
    model, found = load_pi_model(folder / "checkpoint", config=case.config)
    assert found == "openpi_jax"
    expected = from_jax_flat(case.weights, case.config)
    assert model.state_dict().keys() == expected.keys()
    for key, tensor in model.state_dict().items():
        assert torch.equal(tensor, expected[key]), key
    actions = case.sample(model)
    np.testing.assert_allclose(actions, case.expected["actions"], rtol=0, atol=5e-5)


def test_a_checkpoint_is_cast_to_the_wanted_precision(pi0_case):
    model = load_openpi_jax(STORED, config=pi0_case.config, dtype=torch.bfloat16)
    assert model.state_proj.weight.dtype == torch.float32
    assert model.paligemma_with_expert.paligemma.model.language_model.embed_tokens.weight.dtype == torch.bfloat16


def test_without_a_configuration_it_is_taken_for_openpi_s_libero_model():
    with pytest.raises(CheckpointMismatch, match=r"of the wrong shape: .*instead of \(50|missing"):
        load_openpi_jax(STORED)


def test_statistics_come_along():
    assert read_norm_stats(STORED).state.mean.shape == (8,)


def test_missing_chunks_are_an_error_and_not_zeros(checkpoint, pi0_case):
    data = sorted((checkpoint / "params" / "ocdbt.process_0" / "d").iterdir(), key=lambda file: file.stat().st_size)
    data[-1].unlink()
    with pytest.raises(UnreadableCheckpoint, match="files are missing or damaged"):
        load_openpi_jax(checkpoint, config=pi0_case.config)


def test_a_missing_manifest(checkpoint, pi0_case):
    (checkpoint / "params" / "manifest.ocdbt").unlink()
    with pytest.raises(UnreadableCheckpoint, match="cannot be read"):
        load_openpi_jax(checkpoint, config=pi0_case.config)


@pytest.mark.parametrize("text", ["{", "[]", "{}", '{"tree_metadata": {"a": 3}}'])
def test_damaged_metadata(checkpoint, text):
    (checkpoint / "params" / "_METADATA").write_text(text)
    with pytest.raises(UnreadableCheckpoint, match="_METADATA"):
        load_openpi_jax(checkpoint)


def test_unknown_arrays_are_listed_before_anything_is_read(checkpoint, pi0_case):
    path = checkpoint / "params" / "_METADATA"
    metadata = json.loads(path.read_text())
    keys = [{"key": key, "key_type": 2} for key in ("params", "action_in_proj", "lora_a", "value")]
    metadata["tree_metadata"]["extra"] = {"key_metadata": keys}
    path.write_text(json.dumps(metadata))
    with pytest.raises(CheckpointMismatch, match=r"1 arrays.*action_in_proj/lora_a"):
        load_openpi_jax(checkpoint, config=pi0_case.config)


def test_another_format_is_refused():
    with pytest.raises(UnsupportedCheckpoint, match="not a checkpoint in openpi's JAX"):
        load_openpi_jax(GOLDEN / "pi05_batch2" / "checkpoint_openpi_torch")
