"""A checkpoint folder with the files of the published repository: it is loaded, or refused with one sentence."""

from __future__ import annotations

import shutil
import sys
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from tests.kit.cosmos_checkpoint import WEIGHTS_NAME
from tests.kit.cosmos_helpers import INSTRUCTION, OTHER_INSTRUCTION
from tests.kit.policy_inputs import make_observation
from vla_attention.capture.policies.checkpoints import CheckpointNotFound
from vla_attention.capture.policies.cosmos.family import CosmosSettings
from vla_attention.capture.policies.cosmos.loading import load_cosmos_policy
from vla_attention.capture.policies.cosmos.locate import (
    EMBEDDINGS_NAME,
    POLICY_REPOSITORY,
    STATISTICS_NAME,
    VAE_NAME,
    VAE_REPOSITORY,
)
from vla_attention.capture.policies.cosmos.policy import CosmosPolicy
from vla_attention.capture.policies.identity import downloads_of
from vla_attention.capture.policies.sentencepiece_model import EMBEDDED_TOKENIZER
from vla_attention.schemas.errors import BadArgument, UnknownName
from vla_attention.schemas.layout import Role


def load(checkpoint: str) -> CosmosPolicy:
    """The dummy's pictures are smaller than those of the published configuration."""
    return load_cosmos_policy(CosmosSettings(checkpoint, image_size=64, num_denoising_steps_action=3))


@pytest.fixture(autouse=True)
def no_hub(monkeypatch, tmp_path):
    """The tests must not depend on this machine's own cache."""
    monkeypatch.setenv("HF_HUB_CACHE", str(tmp_path / "hub"))


@pytest.fixture
def folder(dummy_folder, tmp_path):
    return shutil.copytree(dummy_folder, tmp_path / "checkpoint")


def test_a_folder_gives_the_policy_that_was_written(folder, dummy, capsys):
    policy = load(str(folder))
    assert policy.config == dummy.config
    assert "spiece.model" in capsys.readouterr().err
    observation = make_observation(0)
    ours = policy.act(policy.prepare(observation, INSTRUCTION), 195)
    assert np.array_equal(ours, dummy.act(dummy.prepare(observation, INSTRUCTION), 195))
    identity = policy.identity()
    assert identity.untrained is False
    assert identity.checkpoint_format == "pt"
    assert identity.digest == dummy.identity().digest


def test_the_file_of_weights_may_be_named_itself(folder):
    shutil.copyfile(folder / WEIGHTS_NAME, folder / "another.pt")
    with pytest.raises(CheckpointNotFound, match=r"--ckpt-path"):
        load(str(folder))
    assert load(str(folder / "another.pt")).num_layers == 3


def test_with_t5s_tokenizer_the_words_are_known(folder):
    shutil.copyfile(EMBEDDED_TOKENIZER, folder / "spiece.model")
    policy = load(str(folder))
    prepared = policy.prepare(make_observation(0), OTHER_INSTRUCTION)
    assert (prepared.key_role["cross"] == Role.INSTRUCTION).sum() == len(prepared.prompt.pieces) > 0


@pytest.mark.parametrize(
    ("missing", "error", "message"),
    [
        (EMBEDDINGS_NAME, CheckpointNotFound, "--t5-text-embeddings-path"),
        (VAE_NAME, CheckpointNotFound, f"hf download {VAE_REPOSITORY} {VAE_NAME}.*--vae-path"),
    ],
)
def test_missing_files_are_named(folder, missing, error, message):
    (folder / missing).unlink()
    with pytest.raises(error, match=message):
        load(str(folder))


def test_a_sentence_without_an_embedding_is_refused_before_the_weights_are_read(folder):
    (folder / WEIGHTS_NAME).write_bytes(b"no weights")
    with pytest.raises(UnknownName, match=r"'fly to the moon'.*encode_prompts .*--prompt 'fly to the moon'"):
        load_cosmos_policy(CosmosSettings(str(folder), image_size=64, instructions=(INSTRUCTION, "fly to the moon")))


def test_embeddings_of_another_model_are_refused(folder, tmp_path):
    import pickle

    with open(folder / EMBEDDINGS_NAME, "wb") as file:
        pickle.dump({INSTRUCTION: torch.ones(1, 64, 7)}, file)
    with pytest.raises(BadArgument, match=r"\b7 .* 24"):
        load(str(folder))


def test_every_file_from_the_hub_is_of_a_commit_that_is_kept(folder, tmp_path, monkeypatch):
    commits = {POLICY_REPOSITORY: "a" * 40, VAE_REPOSITORY: "b" * 40}
    asked = []

    def snapshot_download(name, repo_type, revision, allow_patterns):
        asked.append((name, revision))
        snapshot = tmp_path / "hub" / f"models--{name.replace('/', '--')}" / "snapshots" / commits[name]
        if not snapshot.exists():
            (snapshot / VAE_NAME).parent.mkdir(parents=True)
            if name == VAE_REPOSITORY:
                shutil.move(folder / VAE_NAME, snapshot / VAE_NAME)
            else:
                for file in (WEIGHTS_NAME, STATISTICS_NAME, EMBEDDINGS_NAME):
                    shutil.copyfile(folder / file, snapshot / file)
        return str(snapshot)

    monkeypatch.setitem(sys.modules, "huggingface_hub", SimpleNamespace(snapshot_download=snapshot_download))
    policy = load(POLICY_REPOSITORY)
    assert policy.identity().checkpoint == f"{POLICY_REPOSITORY}@{'a' * 40}"
    assert downloads_of(policy) == {f"hub {name}": commit for name, commit in commits.items()}
    assert load(policy.identity().checkpoint).identity() == policy.identity()
    assert [revision for name, revision in asked if name == POLICY_REPOSITORY] == [None, "a" * 40]
