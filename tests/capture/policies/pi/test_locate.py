"""Names on hubs: calls of the clients, and an error with instructions for every failure."""

import sys
import types

import pytest

from tests.kit.pi_golden import GOLDEN
from vla_attention.capture.policies.hub import CheckpointUnavailable, hub_cache
from vla_attention.capture.policies.pi.locate import (
    HUB_FILES,
    find_checkpoint,
    find_tokenizer,
    openpi_cache,
)
from vla_attention.capture.policies.sentencepiece_model import EMBEDDED_TOKENIZER
from vla_attention.schemas.errors import BadArgument, MissingDependency, UserError

URL = "gs://openpi-assets/checkpoints/pi05_libero"


@pytest.fixture(autouse=True)
def own_caches(tmp_path, monkeypatch):
    monkeypatch.setenv("OPENPI_DATA_HOME", str(tmp_path / "openpi"))
    monkeypatch.setenv("HF_HUB_CACHE", str(tmp_path / "hub"))


def module(monkeypatch, name, **content):
    monkeypatch.setitem(sys.modules, name, types.SimpleNamespace(**content))


def test_local_folders_come_first(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "org" / "name").mkdir(parents=True)
    assert find_checkpoint("org/name").is_dir()
    assert str(find_checkpoint("a/b/c")) == "a/b/c"
    assert str(find_checkpoint("nothing")) == "nothing"


def test_a_hub_name_is_downloaded_by_the_hub_s_client(monkeypatch, tmp_path):
    asked = []

    def snapshot_download(name, repo_type, allow_patterns):
        asked.append((name, allow_patterns))
        return str(tmp_path)

    module(monkeypatch, "huggingface_hub", snapshot_download=snapshot_download)
    assert find_checkpoint("lerobot/pi05_libero_finetuned") == tmp_path
    assert asked == [("lerobot/pi05_libero_finetuned", list(HUB_FILES))]
    # safetensors and JSON only: nothing that has to be unpickled is downloaded
    assert not [pattern for pattern in HUB_FILES if pattern.endswith((".bin", ".pt", ".pth", ".pkl"))]


def test_the_real_client_without_a_network(monkeypatch):
    pytest.importorskip("huggingface_hub")
    from huggingface_hub import constants

    monkeypatch.setattr(constants, "HF_HUB_OFFLINE", True)
    with pytest.raises(CheckpointUnavailable, match=r"hf download lerobot/pi05_base`.*no such local folder") as caught:
        find_checkpoint("lerobot/pi05_base")
    assert isinstance(caught.value, UserError)
    assert "\n" not in str(caught.value)


def test_without_the_hub_s_client(monkeypatch):
    monkeypatch.setitem(sys.modules, "huggingface_hub", None)
    with pytest.raises(MissingDependency, match=r"vla-attention\[hub\].*hf download lerobot/pi05_base"):
        find_checkpoint("lerobot/pi05_base")


def test_openpi_s_cache_is_used_when_the_checkpoint_is_there():
    target = openpi_cache() / "openpi-assets" / "checkpoints" / "pi05_libero"
    target.mkdir(parents=True)
    assert find_checkpoint(URL) == target
    assert find_checkpoint(URL + "/") == target


def test_without_gcsfs_the_error_names_files_and_place(monkeypatch):
    monkeypatch.setitem(sys.modules, "gcsfs", None)
    target = openpi_cache() / "openpi-assets" / "checkpoints"
    with pytest.raises(MissingDependency) as caught:
        find_checkpoint(URL)
    assert f"gsutil -m cp -r {URL} {target}/" in str(caught.value)
    assert str(target / "pi05_libero" / "params") in str(caught.value)


class Bucket:
    """A bucket of gcsfs; `fails` interrupts the download."""

    def __init__(self, fails=False, folders=("params", "assets", "train_state")):
        self.fails, self.folders, self.got = fails, folders, []

    def exists(self, path):
        return path.rsplit("/", 1)[1] in self.folders

    def get(self, source, target, recursive):
        assert recursive
        if self.fails and self.got:
            raise OSError("connection lost\nmore")
        self.got.append(source)
        import pathlib

        pathlib.Path(target).mkdir()
        (pathlib.Path(target) / "file").write_text(source)


def test_gcsfs_downloads_what_is_needed_and_moves_it_into_place(monkeypatch):
    bucket = Bucket()
    module(monkeypatch, "gcsfs", GCSFileSystem=lambda token: bucket)
    target = find_checkpoint(URL)
    assert target == openpi_cache() / "openpi-assets" / "checkpoints" / "pi05_libero"
    assert sorted(path.name for path in target.iterdir()) == ["assets", "params"]
    assert [source.rsplit("/", 1)[1] for source in bucket.got] == ["params", "assets"]
    assert find_checkpoint(URL) == target
    assert len(bucket.got) == 2


@pytest.mark.parametrize(
    ("bucket", "said"), [(Bucket(fails=True), "connection lost"), (Bucket(folders=()), "no checkpoint")]
)
def test_a_download_that_breaks_off_leaves_nothing(monkeypatch, bucket, said):
    module(monkeypatch, "gcsfs", GCSFileSystem=lambda token: bucket)
    with pytest.raises(CheckpointUnavailable, match=said) as caught:
        find_checkpoint(URL)
    assert "\n" not in str(caught.value)
    assert list((openpi_cache() / "openpi-assets" / "checkpoints").iterdir()) == []


def test_tokenizers_are_looked_for_in_the_checkpoint_and_the_caches(tmp_path):
    checkpoint = tmp_path / "checkpoint"
    places = [
        hub_cache() / "models--google--paligemma-3b-pt-224" / "snapshots" / "abc" / "tokenizer.model",
        openpi_cache() / "big_vision" / "paligemma_tokenizer.model",
        checkpoint / "paligemma_tokenizer.model",
        checkpoint / "tokenizer.model",
        checkpoint / "tokenizer" / "tokenizer.model",
    ]
    with pytest.raises(BadArgument, match=r"gs://big_vision/paligemma_tokenizer\.model.*give --tokenizer PATH"):
        find_tokenizer(checkpoint, None)
    for place in places:  # each later one takes precedence over the earlier ones
        place.parent.mkdir(parents=True, exist_ok=True)
        place.touch()
        assert find_tokenizer(checkpoint, None) == place
    assert find_tokenizer(checkpoint, str(EMBEDDED_TOKENIZER)) == EMBEDDED_TOKENIZER


def test_a_stub_is_no_tokenizer():
    with pytest.raises(BadArgument, match="none was found"):
        find_tokenizer(GOLDEN / "pi05_batch2" / "checkpoint_lerobot", None)
