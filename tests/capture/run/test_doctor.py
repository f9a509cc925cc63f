"""Checks of machine and checkpoint, on made-up ones: each line says how it stands and what to do."""

from __future__ import annotations

import re
import shutil
from pathlib import Path
from types import SimpleNamespace

import pytest

from tests.kit.cosmos_checkpoint import WEIGHTS_NAME, write_dummy_folder
from tests.kit.pi_golden import GOLDEN
from tests.kit.small_tokenizer import train_small_tokenizer
from vla_attention.capture.commands.arguments import build_parser
from vla_attention.capture.environments.suites import find_suite
from vla_attention.capture.policies.cosmos.embedded import DUMMY_CONFIG
from vla_attention.capture.policies.cosmos.locate import EMBEDDINGS_NAME, VAE_NAME, VAE_REPOSITORY
from vla_attention.capture.run.doctor import Finding, find_checkpoint, find_drawing, find_gpu, find_robosuite_for
from vla_attention.schemas.errors import UserError
from vla_attention.schemas.libero_physics import MEND, PUBLISHED_MUJOCO


def checkpoint_of(*words: str) -> Finding:
    given = ["doctor", *words]
    return find_checkpoint(build_parser(given).parse_args(given))


def test_a_jax_checkpoint_without_its_arrays_is_missing(tmp_path: Path, monkeypatch):
    """Its list of arrays alone makes no policy; nor does it in the cache of openpi, which is read as it is."""
    monkeypatch.setenv("OPENPI_DATA_HOME", str(tmp_path))
    address = "gs://openpi-assets/checkpoints/mine"
    folder = tmp_path / address.removeprefix("gs://")
    with pytest.raises(UserError, match=address):
        checkpoint_of("pi", "--checkpoint", address)
    shutil.copytree(GOLDEN / "pi0_batch2" / "checkpoint", folder)
    words = ["--model-config", str(GOLDEN / "pi0_batch2" / "case.json")]
    words += ["--tokenizer", str(train_small_tokenizer(tmp_path / "small.model"))]
    assert checkpoint_of("pi", "--checkpoint", str(folder), *words)[0] == "ok"
    for part in (folder / "params").iterdir():
        if part.name != "_METADATA":
            shutil.rmtree(part) if part.is_dir() else part.unlink()
    for name in (str(folder), address):
        with pytest.raises(UserError, match="params"):
            checkpoint_of("pi", "--checkpoint", name, *words)


@pytest.mark.parametrize(
    ("suite", "installed", "status"),
    [("libero_goal", "3.8.1", "note"), ("libero_goal", PUBLISHED_MUJOCO, "ok"), ("cubes", "3.8.1", "ok")],
)
def test_another_physics_than_liberos_is_told_with_what_mends_it(monkeypatch, suite, installed, status):
    pytest.importorskip("robosuite")
    monkeypatch.setattr("vla_attention.capture.run.doctor.version", lambda package: installed)
    found = find_robosuite_for(find_suite(suite))
    assert (found[0], MEND in found[1]) == (status, status == "note")


@pytest.mark.parametrize(
    ("absent", "named"),
    [
        (WEIGHTS_NAME, r"\.pt"),
        (EMBEDDINGS_NAME, "embeddings"),
        (VAE_NAME, f"hf download {VAE_REPOSITORY}"),
    ],
)
def test_every_part_of_a_cosmos_checkpoint_is_looked_for(tmp_path: Path, monkeypatch, absent: str, named: str):
    pytest.importorskip("diffusers")
    monkeypatch.setenv("HF_HUB_CACHE", str(tmp_path / "hub"))
    folder = write_dummy_folder(tmp_path / "checkpoint", DUMMY_CONFIG, ["lift the cube"])
    status, text = checkpoint_of("cosmos", "--ckpt-path", str(folder))
    assert status == "ok", text
    (folder / absent).unlink()
    with pytest.raises(UserError, match=named):
        checkpoint_of("cosmos", "--ckpt-path", str(folder))


def test_a_file_of_no_weights_is_missing(tmp_path: Path, monkeypatch):
    """What a copy without large files leaves in the place of each."""
    pytest.importorskip("diffusers")
    monkeypatch.setenv("HF_HUB_CACHE", str(tmp_path / "hub"))
    cosmos = write_dummy_folder(tmp_path / "cosmos", DUMMY_CONFIG, ["lift the cube"])
    pi = Path(shutil.copytree(GOLDEN / "pi05_batch2" / "checkpoint_lerobot", tmp_path / "pi"))
    for file in (cosmos / WEIGHTS_NAME, pi / "model.safetensors"):
        file.write_text("version https://git-lfs.github.com/spec/v1\noid sha256:4cac\nsize 14467000000\n")
    for words in (("cosmos", "--ckpt-path", str(cosmos)), ("pi", "--checkpoint", str(pi))):
        with pytest.raises(UserError):
            checkpoint_of(*words)


@pytest.mark.parametrize(("renderer", "status"), [("NVIDIA H100/PCIe/SSE2", "ok"), ("llvmpipe (LLVM 15)", "note")])
def test_drawing(renderer: str, status: str):
    found = find_drawing(find_suite("cubes"), None, lambda suite, libero_assets: renderer)
    assert (found[0], renderer in found[1]) == (status, True)


@pytest.mark.simulator
def test_a_picture_is_really_drawn():
    status, text = find_drawing(find_suite("cubes"), None)
    assert status in ("ok", "note"), text


class NoCuda:
    """A torch that finds no GPU. version: of the CUDA that it was built with."""

    __version__ = "2.9"

    def __init__(self, version: str | None):
        self.cuda = SimpleNamespace(is_available=lambda: False)
        self.version = SimpleNamespace(cuda=version)


@pytest.mark.parametrize(
    ("version", "has_driver", "to_do"),
    [(None, True, "pip install"), ("12.8", True, "CUDA_VISIBLE_DEVICES"), ("12.8", False, "sbatch --gres")],
)
def test_a_gpu_that_was_asked_for_is_missing_and_otherwise_is_a_note(tmp_path, version, has_driver, to_do):
    driver = tmp_path / "version"
    if has_driver:
        driver.touch()
    for device, status in (("cuda", "MISSING"), ("auto", "note")):
        found, text = find_gpu(device, NoCuda(version), driver)
        assert (found, to_do in text) == (status, True)


def test_a_gpu_is_named_with_its_memory():
    cuda = SimpleNamespace(
        is_available=lambda: True, mem_get_info=lambda device: (6e9, 80e9), get_device_name=lambda device: "H100"
    )
    version = SimpleNamespace(cuda="12.8")
    status, text = find_gpu("cuda:1", SimpleNamespace(cuda=cuda, version=version, __version__="2.9"))
    assert status == "ok"
    assert re.search("H100.* 6 GB .*80 GB", text)
