"""The T5 encoder of Cosmos, from a folder with a small T5 of the transformers library."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from tests.thorough.hostile_checkpoints.hostile_files import TRACE, executing_pickle
from vla_attention.capture.policies.checkpoints import UnreadableCheckpoint
from vla_attention.capture.policies.cosmos.text import T5Encoder
from vla_attention.schemas.errors import BadArgument

transformers = pytest.importorskip("transformers", reason="run by make test-policies, in .venv-transformers")
if not hasattr(transformers, "T5EncoderModel"):
    pytest.skip("run by make test-policies, in .venv-transformers", allow_module_level=True)

WIDTH, POSITIONS = 16, 12
IDS = [5, 9, 3, 40, 1]


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    torch.manual_seed(0)
    config = transformers.T5Config(
        vocab_size=64, d_model=WIDTH, d_kv=8, d_ff=32, num_layers=2, num_heads=2, decoder_start_token_id=0
    )
    made = tmp_path_factory.mktemp("t5")
    transformers.T5EncoderModel(config).eval().save_pretrained(made)
    return made


def test_the_embedding_is_that_of_the_model_and_padding_is_zero(folder):
    found = T5Encoder(folder).encode(IDS, POSITIONS, WIDTH)
    model = transformers.T5EncoderModel.from_pretrained(folder, dtype=torch.float32).eval()
    with torch.no_grad():  # padded and masked, as the published embeddings were made
        padded = torch.tensor([IDS + [0] * (POSITIONS - len(IDS))])
        mask = (torch.arange(POSITIONS) < len(IDS)).long()[None]
        expected = model(input_ids=padded, attention_mask=mask).last_hidden_state
    assert (found.shape, found.dtype) == ((1, POSITIONS, WIDTH), torch.bfloat16)
    torch.testing.assert_close(found[:, : len(IDS)].float(), expected[:, : len(IDS)], rtol=1e-2, atol=1e-2)
    assert not found[:, len(IDS) :].any()
    assert found[:, : len(IDS)].any()


def test_another_width_and_too_many_tokens_are_refused(folder):
    with pytest.raises(UnreadableCheckpoint, match="gives 16 numbers a position, but the policy reads 1024"):
        T5Encoder(folder).encode(IDS, POSITIONS, 1024)
    with pytest.raises(BadArgument, match="has 5 tokens, but the policy reads 4"):
        T5Encoder(folder).encode(IDS, 4, WIDTH)


@pytest.mark.parametrize("name", ["nothing", "cut off", "executes", "no JSON"])
def test_what_cannot_be_loaded_is_a_sentence(folder, tmp_path, name):
    (tmp_path / "config.json").write_bytes((folder / "config.json").read_bytes())
    if name == "cut off":
        (tmp_path / "model.safetensors").write_bytes((folder / "model.safetensors").read_bytes()[:500])
    elif name == "executes":
        (tmp_path / "pytorch_model.bin").write_bytes(executing_pickle(tmp_path))
    elif name == "no JSON":
        (tmp_path / "config.json").write_text("{")
    with pytest.raises(UnreadableCheckpoint, match="cannot be loaded"):
        T5Encoder(tmp_path).encode(IDS, POSITIONS, WIDTH)
    assert not (tmp_path / TRACE).exists()
