"""openpi's JAX checkpoints: written by openpi and orbax, and read without them."""

import dataclasses
import shutil

import numpy as np
import pytest
import torch

from benchmarks.orbax_writer import write_leaves
from tests.capture.policies.pi.jax_leaves import to_jax_leaves
from tests.capture.policies.pi.jax_state import from_jax_flat
from tests.kit.pi_golden import GOLDEN, LARGE_GOLDEN, load_case
from tests.kit.thorough import thorough_except
from vla_attention.capture.policies.checkpoints import CheckpointMismatch, UnreadableCheckpoint
from vla_attention.capture.policies.pi.config import GemmaConfig
from vla_attention.capture.policies.pi.embedded import DUMMY_CONFIG, random_weights
from vla_attention.capture.policies.pi.jax_weights import merge_lora
from vla_attention.capture.policies.pi.loading import load_pi_model
from vla_attention.capture.policies.pi.openpi_jax import OpenLeaf, list_leaves

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
    """The loader's conversion is inverted by independent code."""
    leaves = list_leaves(STORED / "params")
    wanted = pi0_case.leaves
    assert {leaf.path for leaf in leaves} == set(wanted)
    for leaf in leaves:
        np.testing.assert_array_equal(OpenLeaf(STORED / "params", leaf).read(), wanted[leaf.path])
        opened = OpenLeaf(STORED / "params", leaf)
        np.testing.assert_array_equal(np.stack(list(opened.layers())), wanted[leaf.path])


@pytest.mark.parametrize("name", ["pi0_batch2", "pi05_batch2", "pi05_full_layout"])
def test_loaded_model_is_that_of_the_flat_weights(name):
    folder = LARGE_GOLDEN / name
    if not folder.is_dir():
        pytest.skip("the flat weights are not in the repository, and not beside this checkout")
    case = load_case(folder)
    model = load_pi_model(folder / "checkpoint", case.config, checkpoint_format="openpi_jax")
    expected = from_jax_flat(dict(np.load(folder / "weights_flat.npz")), case.config)
    assert model.state_dict().keys() == expected.keys()
    for key, tensor in model.state_dict().items():
        assert torch.equal(tensor, expected[key]), key


#: As many key heads as query heads (one array for all three), two key heads, and pi0.
OTHER_SIZES = {
    "eight key heads": {"num_kv_heads": 8},
    "two key heads": {"num_heads": 4, "num_kv_heads": 2, "head_dim": 12},
}


@pytest.mark.parametrize("sizes", OTHER_SIZES)
@pytest.mark.parametrize("options", [{"dtype": "bfloat16"}, {"value_suffix": False, "chunk_per_layer": True}, {}])
@pytest.mark.parametrize("pi05", thorough_except((True,), (True, False)))
def test_other_sizes_and_ways_of_storing(tmp_path, sizes, options, pi05):
    parts = {
        name: GemmaConfig(width=width, depth=3, mlp_dim=40, **{"head_dim": 8, **OTHER_SIZES[sizes]})
        for name, width in (("paligemma", 32), ("action_expert", 20))
    }
    config = dataclasses.replace(DUMMY_CONFIG, pi05=pi05, discrete_state_input=False, **parts)
    state = random_weights(config, 3)
    if options.get("dtype") == "bfloat16":
        state = {name: tensor.bfloat16().float() for name, tensor in state.items()}
    leaves = to_jax_leaves(state, config)
    assert any("qkv_einsum" in path for path in leaves) == (sizes == "eight key heads")
    write_leaves(tmp_path / "params", leaves, **options)
    loaded = load_pi_model(tmp_path, config).state_dict()
    for name, tensor in state.items():
        assert torch.equal(loaded[name], tensor), name


def test_other_heads_of_the_same_width_are_refused(tmp_path):
    """One key head of 16 and two of 8 have the same rows; the leaves of a JAX checkpoint tell them apart."""
    several, one = ({"num_heads": 8, "num_kv_heads": 2, "head_dim": 8}, {"num_heads": 4, "head_dim": 16})
    stored, wrong = (
        dataclasses.replace(
            DUMMY_CONFIG,
            **{
                name: GemmaConfig(width=width, depth=2, mlp_dim=40, **heads)
                for name, width in (("paligemma", 32), ("action_expert", 20))
            },
        )
        for heads in (several, one)
    )
    write_leaves(tmp_path / "params", to_jax_leaves(random_weights(stored, 3), stored))
    with pytest.raises(CheckpointMismatch, match=r"_einsum.*\(8, .*\(4, .*--config-name"):
        load_pi_model(tmp_path, wrong)
    assert load_pi_model(tmp_path, stored).config.paligemma.num_kv_heads == 2


def lora_factors(leaves, generator, rank=3):
    """Factors for every weight that openpi adapts, by their names in its models."""
    factors = {}
    for path, w in leaves.items():
        if "/attn/" in path:
            names = [path.removesuffix("w") + f"lora_{x}" for x in "ab"]
        elif "/mlp" in path:
            names = [f"{path}_lora_{x}" for x in "ab"]
        else:
            continue
        factors[names[0]] = generator.normal(size=(*w.shape[:-1], rank)).astype(np.float32)
        factors[names[1]] = generator.normal(size=(*w.shape[:-2], rank, w.shape[-1])).astype(np.float32)
    return factors


def test_lora_is_merged_as_openpi_s_equations_say():
    """openpi evaluates x·w + (x·a)·b by two einsums; their letters determine the sums."""
    generator = np.random.default_rng(0)
    x = generator.normal(size=(2, 5, 6))
    heads = generator.normal(size=(2, 5, 4, 3))

    def of(*shape):
        return generator.normal(size=shape)

    cases = [
        (
            "attn/q_einsum/w", "BTD,NDH->BTNH", "BTD,NDL->BTNL", "BTNL,NLH->BTNH",
            x, of(4, 6, 3), of(4, 6, 2), of(4, 2, 3),
        ),
        (
            "attn/kv_einsum_1/w", "BSD,cKDH->cBSKH", "BSD,cKDL->cBSKL", "cBSKL,cKLH->cBSKH",
            x, of(2, 1, 6, 3), of(2, 1, 6, 2), of(2, 1, 2, 3),
        ),
        (
            "attn/attn_vec_einsum/w", "BTNH,NHD->BTD", "BTNH,NHL->BTL", "BTL,NLD->BTD",
            heads, of(4, 3, 6), of(4, 3, 2), of(4, 2, 6),
        ),
        (
            "mlp/gating_einsum", "BTD,cDF->cBTF", "BTD,cDL->cBTL", "cBTL,cLF->cBTF",
            x, of(2, 6, 7), of(2, 6, 2), of(2, 2, 7),
        ),
    ]  # fmt: skip
    for path, plain, first, second, given, w, a, b in cases:
        wanted = np.einsum(plain, given, w) + np.einsum(second, np.einsum(first, given, a), b)
        merged = merge_lora(f"PaliGemma/llm/layers/{path}", w, a, b)
        np.testing.assert_allclose(np.einsum(plain, given, merged), wanted, rtol=1e-5, atol=1e-5, err_msg=path)


def test_a_lora_checkpoint_is_merged_layer_by_layer(tmp_path):
    state = random_weights(DUMMY_CONFIG, 1)
    leaves = to_jax_leaves(state, DUMMY_CONFIG)
    factors = lora_factors(leaves, np.random.default_rng(1))
    assert len(factors) == 20
    write_leaves(tmp_path / "params", leaves | factors)
    loaded = load_pi_model(tmp_path, DUMMY_CONFIG).state_dict()
    expected = from_jax_flat(leaves | factors, DUMMY_CONFIG)
    for name, tensor in expected.items():
        assert torch.equal(loaded[name], tensor), name
    changed = [name for name in state if not torch.equal(state[name], loaded[name])]
    assert len(changed) == 2 * 3 * 7


def test_half_a_lora_pair_is_refused_by_name(tmp_path):
    leaves = to_jax_leaves(random_weights(DUMMY_CONFIG, 1), DUMMY_CONFIG)
    factors = lora_factors(leaves, np.random.default_rng(1))
    del factors["PaliGemma/llm/layers/mlp_1/linear_lora_b"]
    write_leaves(tmp_path / "params", leaves | factors)
    with pytest.raises(CheckpointMismatch, match=r"1 arrays.*mlp_1/linear_lora_a"):
        load_pi_model(tmp_path, DUMMY_CONFIG)


def test_bfloat16_rounds_every_weight_as_openpi_s_server_does(pi0_case):
    model = load_pi_model(STORED, pi0_case.config, dtype=torch.bfloat16)
    assert torch.equal(model.state_proj.weight, pi0_case.weights["state_proj.weight"].bfloat16().float())


def test_missing_chunks_are_an_error_and_not_zeros(checkpoint, pi0_case):
    data = sorted((checkpoint / "params" / "ocdbt.process_0" / "d").iterdir(), key=lambda file: file.stat().st_size)
    data[-1].unlink()
    with pytest.raises(UnreadableCheckpoint):
        load_pi_model(checkpoint, pi0_case.config)
