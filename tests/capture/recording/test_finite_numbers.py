"""Numbers that turn NaN: at load the tensor is named, at a replan the layer and denoise step where it began."""

from __future__ import annotations

import shutil
from collections.abc import Callable

import pytest
import torch
from safetensors.torch import load_file, save_file
from torch import Tensor

from tests.kit.pi_golden import GOLDEN
from tests.kit.small_tokenizer import train_small_tokenizer
from tests.kit.still_scene import capture_without_simulator
from vla_attention.capture.__main__ import main as capture
from vla_attention.capture.policies.cosmos.dit import Dit
from vla_attention.capture.policies.pi.model import PiModel
from vla_attention.capture.policies.weights import WeightsNotFinite, weights_digest
from vla_attention.schemas.stores.reader import open_store
from vla_attention.schemas.stores.verify import verify_store

#: The same episode 0 is written before the policy is spoiled: it must stay whole.
DUMMY = {
    "pi": [
        "pi",
        "--checkpoint",
        "untrained-tiny",
        "--task-suite",
        "robosuite",
        "--task-id",
        "0",
        "--replan-steps",
        "4",
        "--max-steps",
        "8",
    ],
    "cosmos": ["cosmos", "--ckpt-path", "untrained-tiny", "--task-id", "0", "--max-steps", "8"],
}


@pytest.fixture
def spoil(monkeypatch) -> Callable[[type, str, Callable[[int, Tensor], Tensor]], None]:
    """Change a module's output: `spoil(model class, name of the module, f(number of the call, output))`."""

    def change(model_class: type, name: str, edit: Callable[[int, Tensor], Tensor]) -> None:
        original = model_class.eval

        def eval_and_hook(model):
            calls = iter(range(10**6))
            model.get_submodule(name).register_forward_hook(lambda _, __, output: edit(next(calls), output))
            return original(model)

        monkeypatch.setattr(model_class, "eval", eval_and_hook)

    return change


def overflow(from_call: int, every: int) -> Callable[[int, Tensor], Tensor]:
    """From a call on, every so many calls; a repeated policy call then gives the same numbers."""
    return lambda call, output: (
        output * float("inf") if call >= from_call and (call - from_call) % every == 0 else output
    )


EXPERT = "paligemma_with_expert.gemma_expert.model.layers"


@pytest.mark.parametrize(
    ("family", "module", "calls", "replan", "where"),
    [
        ("pi", f"{EXPERT}.1.mlp.down_proj", (4, 3), 1, "at denoise step 1, layer 1"),
        pytest.param(
            "cosmos", "blocks.1.self_attn.q_proj", (2, 3), 0, "at denoise step 2, layer 1", marks=pytest.mark.thorough
        ),
    ],
)
def test_a_policy_that_overflows_is_reported_with_its_first_layer(
    tmp_path, monkeypatch, capsys, spoil, family, module, calls, replan, where
):
    capture_without_simulator(monkeypatch)
    store = tmp_path / "a.zarr"
    arguments = [*DUMMY[family], "--output", str(store)]
    assert capture([*arguments, "--num-episodes", "1"]) == 0
    spoil({"pi": PiModel, "cosmos": Dit}[family], module, overflow(*calls))
    capsys.readouterr()
    assert capture([*arguments, "--num-episodes", "2", "--resume"]) == 2
    said = capsys.readouterr()
    assert "Traceback" not in said.err
    assert said.err.count("\n") == 1
    step = 4 * replan  # actions of a chunk that are executed
    assert f"replan {replan} (environment step {10 + step}) of episode task000_episode001" in said.err
    assert f"{where}, in the output of {'dit.' * (family == 'cosmos')}{module}. " in said.err
    (episode,) = open_store(store).episodes
    assert episode.name == "task000_episode000"
    assert verify_store(open_store(store)) == []
    assert not (tmp_path / "a.zarr" / ".writing").exists()


def test_a_checkpoint_with_nan_names_the_tensor_and_makes_no_store(tmp_path, monkeypatch, capsys):
    capture_without_simulator(monkeypatch)
    source = GOLDEN / "pi05_batch2" / "checkpoint_openpi_torch"
    checkpoint = tmp_path / "case" / source.name
    shutil.copytree(source, checkpoint)
    shutil.copyfile(source.parent / "case.json", tmp_path / "case" / "case.json")
    tensors = load_file(checkpoint / "model.safetensors")
    name = next(name for name in tensors if name.endswith("gemma_expert.model.layers.1.mlp.down_proj.weight"))
    tensors[name].view(-1)[5:8] = float("nan")
    tensors["action_out_proj.bias"][0] = float("inf")
    save_file(tensors, checkpoint / "model.safetensors")
    store = tmp_path / "a.zarr"
    tokenizer = train_small_tokenizer(tmp_path / "small.model")
    assert capture(["pi", "--checkpoint", str(checkpoint), "--tokenizer", str(tokenizer), "--output", str(store)]) == 2
    said = capsys.readouterr().err
    assert f"2 tensors: action_out_proj.bias (1 of {len(tensors['action_out_proj.bias'])}" in said
    assert f"{name} (3 of " in said
    assert said.count("\n") == 1
    assert not store.exists()


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
@pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf")])
def test_one_number_is_enough(dtype, value):
    layer = torch.nn.Linear(300, 7).to(dtype)
    assert len(weights_digest(layer)) == 64
    with torch.no_grad():
        layer.weight[3, 299] = value
    with pytest.raises(WeightsNotFinite, match=r"\b1 tensors: weight \(1 of 2100 "):
        weights_digest(layer)
