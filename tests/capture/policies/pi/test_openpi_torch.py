"""openpi's PyTorch checkpoints: loading, and one sentence for each checkpoint that cannot be loaded."""

import dataclasses
import re
import shutil

import numpy as np
import pytest
import torch
from safetensors.torch import load_file, save_file

from tests.capture.policies.pi.jax_state import from_jax_flat
from tests.kit.pi_golden import GOLDEN, read_manifest
from tests.kit.policy_inputs import KeepAll
from vla_attention.capture.policies.checkpoints import CheckpointMismatch, UnreadableCheckpoint
from vla_attention.capture.policies.pi.config import NAMED_CONFIGS, SiglipConfig, find_config, find_variant
from vla_attention.capture.policies.pi.jax_weights import plan_leaves
from vla_attention.capture.policies.pi.loading import load_pi_model
from vla_attention.capture.policies.pi.model import PiModel, expected_shapes
from vla_attention.capture.policies.pi.openpi_torch import model_names
from vla_attention.capture.policies.pi.sizes import stated_config
from vla_attention.capture.policies.weights import check_shapes
from vla_attention.schemas.errors import BadArgument, UserError

STORED = GOLDEN / "pi05_batch2" / "checkpoint_openpi_torch"
TABLE = "paligemma_with_expert.paligemma.model.language_model.embed_tokens.weight"
TIED = "paligemma_with_expert.paligemma.lm_head.weight"


@pytest.fixture
def checkpoint(tmp_path):
    """A copy of openpi's small checkpoint that a test may damage."""
    folder = tmp_path / "checkpoint"
    shutil.copytree(STORED, folder)
    return folder


def rewrite(folder, change):
    tensors = load_file(folder / "model.safetensors")
    change(tensors)
    save_file(tensors, folder / "model.safetensors")


def test_jax_leaves_convert_to_the_same_model(pi05_case):
    loaded = load_pi_model(STORED, pi05_case.config).state_dict()
    converted = from_jax_flat(pi05_case.leaves, pi05_case.config)
    assert loaded.keys() == converted.keys()
    for name, tensor in converted.items():
        assert torch.equal(loaded[name], tensor), name


def test_loaded_model_meets_the_reference(pi05_case):
    keep = KeepAll()
    pi05_case.sample(load_pi_model(STORED, pi05_case.config), keep)
    np.testing.assert_allclose(keep.stacked(), pi05_case.expected["attn"], rtol=0, atol=5e-5)


def test_embed_tokens_wins_over_the_tied_name(checkpoint, pi05_case):
    def add_table(tensors):
        tensors[TABLE] = torch.full_like(tensors[TIED], 7.0)

    rewrite(checkpoint, add_table)
    assert (load_pi_model(checkpoint, pi05_case.config).state_dict()[TABLE] == 7).all()


#: The rows of gemma_2b's projections (8 query heads and one key head of 256) as other heads.
OTHER_HEADS = {"num_heads": 16, "num_kv_heads": 2, "head_dim": 128}
NAMED = {"paligemma_variant": "gemma_2b", "action_expert_variant": "gemma_300m"}


def full_size(**heads):
    plain = find_config("pi05_libero")
    parts = {name: dataclasses.replace(getattr(plain, name), **heads) for name in ("paligemma", "action_expert")}
    return dataclasses.replace(plain, **parts)


@pytest.mark.parametrize("name", NAMED_CONFIGS)
def test_sizes_are_those_that_config_json_names(name):
    config = find_config(name)
    stated = {"action_dim": 32, "action_horizon": config.action_horizon, **NAMED}
    # Whether the prompt has the state is not stated.
    assert stated_config(stated, pi05=config.pi05) == dataclasses.replace(config, discrete_state_input=False)


def test_heads_that_nobody_states_are_asked_for():
    """The tensors have the same shapes whether there are 8 heads of 256 or 16 of 128."""
    assert expected_shapes(full_size(**OTHER_HEADS)) == expected_shapes(find_config("pi05_libero"))
    for variant in ({}, {"paligemma_variant": "gemma_3b"}, {"action_expert_variant": None}):
        stated = {"action_dim": 32, "action_horizon": 10, **(NAMED | variant if variant else {})}
        with pytest.raises(CheckpointMismatch, match="--model-config PATH"):
            stated_config(stated, pi05=True)
    lora = {name: f"{variant}_lora" for name, variant in NAMED.items()}
    stated = {"action_dim": 32, "action_horizon": 10, **lora}
    assert stated_config(stated, pi05=True) == find_config("pi05_libero")


@pytest.mark.parametrize("heads", [{"num_kv_heads": 2}, {"num_kv_heads": 1, "head_dim": 192}])
def test_more_key_heads_than_the_named_variant_has_are_noticed(heads):
    named = stated_config({"action_dim": 32, "action_horizon": 10, **NAMED}, pi05=True)
    with pytest.raises(CheckpointMismatch, match=r"k_proj\.weight"):
        check_shapes(expected_shapes(full_size(**heads)), expected_shapes(named))


def test_every_difference_is_listed_in_one_error(checkpoint, pi05_case):
    def damage(tensors):
        del tensors["time_mlp_out.bias"]
        tensors["state_proj.weight"] = torch.zeros(48, 32)
        tensors["action_in_proj.bias"] = torch.zeros(5)

    rewrite(checkpoint, damage)
    with pytest.raises(CheckpointMismatch) as caught:
        load_pi_model(checkpoint, pi05_case.config)
    text = str(caught.value)
    assert re.search(r"\b1 .*time_mlp_out\.bias", text)
    assert re.search(r"\b1 .*state_proj\.weight", text)
    assert re.search(r"\b1 .*action_in_proj\.bias .*\(5,\).*\(48,\)", text)
    assert isinstance(caught.value, (UserError, ValueError))


@pytest.mark.parametrize("kept", [0.5])
def test_truncated_safetensors(checkpoint, pi05_case, kept):
    file = checkpoint / "model.safetensors"
    content = file.read_bytes()
    file.write_bytes(content[: int(len(content) * kept)])
    with pytest.raises(UnreadableCheckpoint):
        load_pi_model(checkpoint, pi05_case.config)


def test_sizes_that_do_not_fit_are_refused():
    full = find_config("pi05_libero")
    with pytest.raises(BadArgument, match="depth"):
        dataclasses.replace(full, action_expert=find_variant("dummy"))
    with pytest.raises(BadArgument, match=r"225|whole number"):
        dataclasses.replace(full, siglip=SiglipConfig(image_size=225))
    assert (full.prefix_len, full.suffix_len) == (968, 10)
    pi0 = find_config("pi0_libero")
    assert (pi0.prefix_len, pi0.suffix_len, pi0.first_action_query) == (816, 51, 1)


@pytest.mark.parametrize("name", ["pi05_libero", "pi0_libero"])
def test_full_size_openpi_torch_keys_load_strictly(name):
    manifest = read_manifest(f"openpi_torch_{name}")
    shapes = {key: manifest[raw] for key, raw in model_names(manifest).items()}
    horizon = find_config(name).action_horizon
    config = stated_config({"action_dim": 32, "action_horizon": horizon, **NAMED}, pi05=name == "pi05_libero")
    assert config == find_config(name)
    load_meta(shapes, config)


@pytest.mark.parametrize(("name", "kind"), [("lerobot_pi05", "pi05_libero"), ("lerobot_pi0", "pi0_libero")])
@pytest.mark.parametrize("leave_out", ["", "embed_tokens.weight", "prefix"])
def test_full_size_lerobot_keys_load_strictly(name, kind, leave_out):
    """With and without the prefix "model." and the table's own name, like older files."""
    manifest = read_manifest(name)
    if leave_out == "prefix":
        manifest = {key.removeprefix("model."): shape for key, shape in manifest.items()}
    elif leave_out:
        manifest = {key: shape for key, shape in manifest.items() if not key.endswith(leave_out)}
        assert len(manifest) == len(read_manifest(name)) - 1
    shapes = {key: manifest[raw] for key, raw in model_names(manifest).items()}
    config = stated_config({"action_horizon": 50, "action_dim": 32, **NAMED}, pi05=kind == "pi05_libero")
    assert config == dataclasses.replace(find_config(kind), action_horizon=50)
    load_meta(shapes, config)


@pytest.mark.parametrize("name", ["pi05_libero", "pi0_libero"])
def test_full_size_jax_leaves_load_strictly(name):
    leaves = read_manifest(f"openpi_jax_{name}")
    plans, pairs = plan_leaves(leaves)
    assert not pairs
    shapes = {}
    for path, plan in plans.items():
        shapes |= plan.shapes(leaves[path])
    load_meta(shapes, find_config(name))


def load_meta(shapes, config):
    """Load tensors without memory into a model without memory, strictly."""
    check_shapes(shapes, expected_shapes(config))
    with torch.device("meta"):
        model = PiModel(config)
    model.load_state_dict({name: torch.empty(shape, device="meta") for name, shape in shapes.items()}, strict=True)


def test_pi0_fast_is_named(pi05_case):
    leaves = [path for path in pi05_case.leaves if "_1" not in path and "time" not in path and "action" not in path]
    with pytest.raises(CheckpointMismatch, match="pi0-FAST"):
        plan_leaves(leaves)
