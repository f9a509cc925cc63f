"""Checkpoints as their trainers leave them: what is read with an option, and one sentence for everything else."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file, save_file

from tests.capture.run.test_doctor import checkpoint_of
from tests.kit.pi_golden import GOLDEN
from tests.kit.small_tokenizer import train_small_tokenizer
from tests.kit.still_scene import capture_without_simulator
from vla_attention.capture.__main__ import main as capture
from vla_attention.capture.policies.pi.family import PiSettings
from vla_attention.capture.policies.pi.loading import build_pi_policy
from vla_attention.schemas.errors import UserError
from vla_attention.schemas.stores.reader import open_store

CASE = GOLDEN / "pi05_batch2" / "case.json"
STATS = GOLDEN / "libero_preproc" / "norm_stats.json"
ASSET = "assets/physical-intelligence/libero"


@pytest.fixture(scope="module")
def tokenizer(tmp_path_factory) -> str:
    return str(train_small_tokenizer(tmp_path_factory.mktemp("tokenizer") / "small.model"))


@pytest.fixture(autouse=True)
def own_caches(tmp_path, monkeypatch) -> None:
    monkeypatch.setenv("OPENPI_DATA_HOME", str(tmp_path / "openpi"))
    monkeypatch.setenv("HF_HUB_CACHE", str(tmp_path / "hub"))
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")


def trained(folder: Path, of: str = "pi05_batch2/checkpoint_openpi_torch") -> Path:
    """A step of openpi's train_pytorch.py: weights, the states of its optimiser, statistics; no config.json."""
    shutil.copytree(GOLDEN / of, folder, ignore=shutil.ignore_patterns("config.json"))
    for name in ("optimizer.pt", "metadata.pt"):
        (folder / name).touch()
    (folder / ASSET).mkdir(parents=True, exist_ok=True)
    shutil.copyfile(STATS, folder / ASSET / "norm_stats.json")
    return folder


def split(folder: Path) -> dict[str, str]:
    """Put the tensors of a checkpoint into three files with an index, as transformers does; returns the index."""
    tensors = load_file(folder / "model.safetensors")
    (folder / "model.safetensors").unlink()
    names = sorted(tensors)
    file_of = {name: f"model-0000{i % 3 + 1}-of-00003.safetensors" for i, name in enumerate(names)}
    for file in set(file_of.values()):
        save_file({name: tensors[name] for name in names if file_of[name] == file}, folder / file)
    (folder / "model.safetensors.index.json").write_text(json.dumps({"metadata": {}, "weight_map": file_of}))
    return file_of


def build(folder: Path, tokenizer: str, **options):
    return build_pi_policy(PiSettings(str(folder), tokenizer=tokenizer, **options), "cpu")


def test_a_step_of_openpi_s_training_is_read_with_its_sizes(tmp_path, tokenizer):
    folder = trained(tmp_path / "run" / "29999")
    with pytest.raises(UserError, match=r"config\.json.*--config-name NAME .*pi05_libero.*--model-config FILE"):
        build(folder, tokenizer)
    policy = build(folder, tokenizer, model_config=CASE)
    expected = load_file(folder / "model.safetensors")
    name = "action_in_proj.weight"
    assert torch.equal(policy.model.state_dict()[name], expected[name])
    assert policy.identity().config["model_config"] == str(CASE)
    with pytest.raises(UserError, match="tensors"):
        build(folder, tokenizer, config_name="pi05_libero")  # of another size


@pytest.mark.parametrize("of", ["pi05_batch2/checkpoint_openpi_torch", "pi05_batch2/checkpoint_lerobot"])
def test_weights_in_several_files_are_those_of_one(tmp_path, tokenizer, of):
    if "openpi" in of:
        folder = trained(tmp_path / "checkpoint", of)
    else:
        folder = Path(shutil.copytree(GOLDEN / of, tmp_path / "checkpoint"))
    whole = build(folder, tokenizer, model_config=CASE).identity().digest
    file_of = split(folder)
    assert build(folder, tokenizer, model_config=CASE).identity().digest == whole
    first = sorted(set(file_of.values()))[0]
    (folder / first).rename(tmp_path / first)
    with pytest.raises(UserError, match=first):
        build(folder, tokenizer, model_config=CASE)
    tensors = load_file(tmp_path / first)
    dropped = sorted(tensors)[0]
    del tensors[dropped]
    save_file(tensors, folder / first)
    with pytest.raises(UserError, match=dropped):
        build(folder, tokenizer, model_config=CASE)
    outside = {"weight_map": dict.fromkeys(file_of, "../model.safetensors")}
    (folder / "model.safetensors.index.json").write_text(json.dumps(outside))
    with pytest.raises(UserError, match="weight_map"):
        build(folder, tokenizer, model_config=CASE)


def adapter(folder: Path) -> None:
    (folder / "adapter_model.safetensors").touch()
    (folder / "adapter_config.json").write_text(json.dumps({"peft_type": "LORA", "base_model_name_or_path": "my/pi05"}))


def unmerged(folder: Path) -> None:
    tensors = load_file(folder / "model.safetensors")
    save_file({**tensors, "model.q_proj.lora_A.default.weight": torch.zeros(2, 2)}, folder / "model.safetensors")


def steps(folder: Path, *names: str) -> None:
    for name in names:
        (folder / name).mkdir(parents=True)
        (folder / name / "model.safetensors").touch()


def run_of_openpi(folder: Path) -> None:
    """A run of train_pytorch.py, or of JAX, with a step that was not saved to its end."""
    shutil.rmtree(folder)
    steps(folder, "5000", "29999", "tmp_30000")
    (folder / "20000" / "params").mkdir(parents=True)
    (folder / "20000" / "params" / "_METADATA").touch()


def run_of_lerobot(folder: Path) -> None:
    shutil.rmtree(folder)
    steps(folder, "checkpoints/005000/pretrained_model", "checkpoints/020000/pretrained_model")


def without_weights(folder: Path) -> None:
    (folder / "model.safetensors").unlink()


def without_statistics(folder: Path) -> None:
    shutil.rmtree(folder / "assets")


def two_statistics(folder: Path) -> None:
    (folder / "assets" / "droid").mkdir()
    shutil.copyfile(STATS, folder / "assets" / "droid" / "norm_stats.json")


@pytest.mark.parametrize(
    ("change", "named"),
    [
        (adapter, "my/pi05.*merge_and_unload"),
        (unmerged, "merge_and_unload"),
        (run_of_openpi, r"29999, 20000, 5000\."),
        (run_of_lerobot, r"checkpoints/020000/pretrained_model, checkpoints/005000/pretrained_model\."),
        (without_weights, r"assets, metadata\.pt, optimizer\.pt"),
        (without_statistics, r"norm_stats\.json.*--norm-stats FILE"),
        (two_statistics, "droid, physical-intelligence/libero.*--asset-id NAME"),
    ],
)
def test_what_else_trainers_leave_is_said_with_the_next_step(
    tmp_path, tokenizer, change: Callable[[Path], None], named: str
):
    """By capture, and by the doctor, which loads nothing."""
    folder = trained(tmp_path / "checkpoint")
    change(folder)
    with pytest.raises(UserError, match=named):
        build(folder, tokenizer, model_config=CASE)
    with pytest.raises(UserError):
        checkpoint_of("pi", *words_of(folder, tokenizer))


def words_of(folder: Path, tokenizer: str) -> list[str]:
    return ["--checkpoint", str(folder), "--model-config", str(CASE), "--tokenizer", tokenizer]


def test_doctor_is_content_with_a_whole_checkpoint(tmp_path, tokenizer):
    assert checkpoint_of("pi", *words_of(trained(tmp_path / "checkpoint"), tokenizer))[0] == "ok"


@pytest.mark.parametrize("cached", [False, True])
def test_a_name_of_openpi_without_a_path_is_told_its_address(tmp_path, tokenizer, monkeypatch, cached):
    monkeypatch.chdir(tmp_path)
    place = tmp_path / "openpi" / "openpi-assets" / "checkpoints" / "pi05_libero"
    if cached:
        place.mkdir(parents=True)
    with pytest.raises(UserError) as raised:
        build(Path("pi05_libero"), tokenizer)
    assert "gs://openpi-assets/checkpoints/pi05_libero" in str(raised.value)
    assert str(place) in str(raised.value)
    if not cached:  # the default of the published script
        with pytest.raises(UserError, match="gs://openpi-assets/checkpoints/pi05_libero"):
            build(place, tokenizer)


def test_statistics_and_cameras_that_were_chosen_are_chosen_again_by_a_rerun(tmp_path, tokenizer, monkeypatch, capsys):
    capture_without_simulator(monkeypatch)
    folder = trained(tmp_path / "checkpoint")
    two_statistics(folder)
    model = ["--checkpoint", str(folder), "--model-config", str(CASE), "--tokenizer", tokenizer, "--asset-id", "droid"]
    cameras = ["--camera", "left_wrist_0_rgb=none", "--camera", "right_wrist_0_rgb=agentview"]
    where = ["--task-suite", "robosuite", "--task-id", "0", "--num-episodes", "1", "--max-steps", "3"]
    assert capture(["pi", *model, *cameras, *where, "--output", str(tmp_path / "a.zarr")]) == 0
    policy = open_store(tmp_path / "a.zarr").attributes.policy
    assert [(camera.name, camera.source) for camera in policy.cameras] == [
        ("base_0_rgb", "agentview"),
        ("right_wrist_0_rgb", "agentview"),
    ]
    assert policy.config["asset_id"] == "droid"
    capsys.readouterr()
    assert capture(["rerun", str(tmp_path / "a.zarr"), "--tokenizer", tokenizer]) == 0
    assert "bit-equal" in capsys.readouterr().out


@pytest.mark.parametrize("of", ["pi05_batch2/checkpoint_openpi_torch", "pi05_batch2/checkpoint_lerobot"])
def test_cameras_are_chosen_by_name_on_both_sides(tmp_path, tokenizer, of):
    lerobot = of.endswith("lerobot")
    folder = tmp_path / "checkpoint"
    if lerobot:
        shutil.copytree(GOLDEN / of, folder)
        config = json.loads((folder / "config.json").read_text())
        features = config["input_features"]
        features["observation.images.front"] = features.pop("observation.images.image")
        (folder / "config.json").write_text(json.dumps(config))
    else:
        trained(folder, of)
    first = "front" if lerobot else "base_0_rgb"
    policy = build(folder, tokenizer, model_config=CASE, camera=(f"{first}=robot0_eye_in_hand",))
    assert {camera.name: camera.source for camera in policy.cameras}[first] == "robot0_eye_in_hand"
    if lerobot:  # its own name of the feature means the same
        same = ("observation.images.front=robot0_eye_in_hand",)
        assert build(folder, tokenizer, model_config=CASE, camera=same).cameras == policy.cameras
    for wrong, named in (
        (["base=agentview"], f"'base'.*{first}"),
        ([f"{first}=frontview"], "'frontview'.*agentview, robot0_eye_in_hand, none"),
        ([f"{camera.name}=none" for camera in policy.cameras], "--camera"),
    ):
        with pytest.raises(UserError, match=named):
            build(folder, tokenizer, model_config=CASE, camera=tuple(wrong))
