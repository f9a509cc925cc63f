"""Names on hubs: calls of the clients, and an error with instructions for every failure."""

import json
import shutil
import sys
import types

import pytest

from tests.kit.pi_golden import GOLDEN
from tests.kit.small_tokenizer import train_small_tokenizer
from tests.kit.still_scene import capture_without_simulator
from vla_attention.capture.__main__ import main as capture
from vla_attention.capture.policies.identity import downloads_of
from vla_attention.capture.policies.pi.family import PiSettings
from vla_attention.capture.policies.pi.loading import build_pi_policy
from vla_attention.capture.policies.pi.locate import (
    HUB_FILES,
    find_checkpoint,
    openpi_cache,
)
from vla_attention.schemas.hub import (
    hub_cache,
)

URL = "gs://openpi-assets/checkpoints/pi05_libero"


@pytest.fixture(autouse=True)
def own_caches(tmp_path, monkeypatch):
    monkeypatch.setenv("OPENPI_DATA_HOME", str(tmp_path / "openpi"))
    monkeypatch.setenv("HF_HUB_CACHE", str(tmp_path / "hub"))


def module(monkeypatch, name, **content):
    monkeypatch.setitem(sys.modules, name, types.SimpleNamespace(**content))


def test_a_hub_name_is_downloaded_by_the_hub_s_client(monkeypatch, tmp_path):
    asked = []

    def snapshot_download(name, repo_type, revision, allow_patterns):
        asked.append((name, revision, allow_patterns))
        return str(tmp_path)

    module(monkeypatch, "huggingface_hub", snapshot_download=snapshot_download)
    assert find_checkpoint("lerobot/pi05_libero_finetuned") == tmp_path
    assert find_checkpoint("lerobot/pi05_libero_finetuned@v1.0") == tmp_path
    name = "lerobot/pi05_libero_finetuned"
    assert asked == [(name, None, list(HUB_FILES)), (name, "v1.0", list(HUB_FILES))]
    # safetensors and JSON only: nothing that has to be unpickled is downloaded
    assert not [pattern for pattern in HUB_FILES if pattern.endswith((".bin", ".pt", ".pth", ".pkl"))]


COMMIT, OTHER = "a" * 40, "b" * 40


@pytest.fixture
def asked(monkeypatch) -> list[tuple[str, str | None]]:
    """What a client is asked for that gives the golden checkpoint, at one commit."""
    asked = []

    def snapshot_download(name, repo_type, revision, allow_patterns):
        asked.append((name, revision))
        folder = hub_cache() / f"models--{name.replace('/', '--')}" / "snapshots" / COMMIT
        if not folder.exists():
            shutil.copytree(GOLDEN / "pi05_batch2" / "checkpoint_openpi_torch", folder)
            # In the cache, files are links to the blobs of their repository.
            blobs = folder.parents[1] / "blobs"
            blobs.mkdir()
            (folder / "model.safetensors").rename(blobs / "1")
            (folder / "model.safetensors").symlink_to("../../blobs/1")
            shutil.copyfile(GOLDEN / "pi05_batch2" / "case.json", folder.parent / "case.json")
        return str(folder)

    module(monkeypatch, "huggingface_hub", snapshot_download=snapshot_download)
    return asked


def test_a_policy_from_the_hub_says_its_commit_and_is_built_again_from_it(asked):
    tokenizer = train_small_tokenizer(hub_cache().parent / "small.model")
    policy = build_pi_policy(PiSettings("org/name", tokenizer=str(tokenizer)), "cpu")
    assert policy.identity().checkpoint == f"org/name@{COMMIT}"
    assert downloads_of(policy) == {"hub org/name": COMMIT}
    again = build_pi_policy(PiSettings(policy.identity().checkpoint, tokenizer=str(tokenizer)), "cpu")
    assert again.identity() == policy.identity()
    assert asked == [("org/name", None), ("org/name", COMMIT)]


@pytest.mark.thorough
def test_a_store_keeps_the_commit_and_a_rerun_asks_for_it(asked, tmp_path, monkeypatch):
    capture_without_simulator(monkeypatch)
    tokenizer = train_small_tokenizer(tmp_path / "small.model")
    store = tmp_path / "run.zarr"
    model = ["--checkpoint", "org/name", "--tokenizer", str(tokenizer), "--device", "cpu"]
    where = ["--task-suite", "robosuite", "--task-id", "0", "--num-episodes", "1", "--max-steps", "3"]
    assert capture(["pi", *model, *where, "--output", str(store)]) == 0
    root = json.loads((store / "zarr.json").read_text())["attributes"]
    assert root["policy"]["checkpoint"] == f"org/name@{COMMIT}"
    assert root["provenance"]["hub org/name"] == COMMIT
    episode = json.loads((store / "episodes" / "task000_episode000" / "zarr.json").read_text())["attributes"]
    assert episode["provenance"]["hub org/name"] == COMMIT
    again = tmp_path / "again.zarr"
    assert capture(["rerun", str(store), "--tokenizer", str(tokenizer), "--device", "cpu", "--output", str(again)]) == 0
    assert asked == [("org/name", None), ("org/name", COMMIT)]


def test_openpi_s_cache_is_used_when_the_checkpoint_is_there():
    target = openpi_cache() / "openpi-assets" / "checkpoints" / "pi05_libero"
    target.mkdir(parents=True)
    assert find_checkpoint(URL) == target
    assert find_checkpoint(URL + "/") == target
