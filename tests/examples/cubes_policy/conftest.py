from __future__ import annotations

import pytest

from examples.cubes_policy.dataset import read_demonstrations
from examples.cubes_policy.vocabulary import make_tokenizer
from tests.kit.made_up_demonstrations import write_demonstrations
from vla_attention.capture.policies.pi.tokenizer import PromptTokenizer


@pytest.fixture(scope="session")
def folder(tmp_path_factory):
    return write_demonstrations(tmp_path_factory.mktemp("demonstrations"))


@pytest.fixture(scope="session")
def demonstrations(folder):
    return read_demonstrations(folder)


@pytest.fixture(scope="session")
def tokenizer(tmp_path_factory):
    path = tmp_path_factory.mktemp("tokenizer") / "tokenizer.model"
    path.write_bytes(make_tokenizer())
    return PromptTokenizer(path)
