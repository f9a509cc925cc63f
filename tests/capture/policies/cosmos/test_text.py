"""Text embeddings: reading without execution of code, look-up by instruction, roles of positions."""

from __future__ import annotations

import os
import pickle
import shutil
from pathlib import Path

import pytest
import torch

from tests.kit.cosmos_helpers import INSTRUCTION
from vla_attention.capture.policies.checkpoints import UnreadableCheckpoint
from vla_attention.capture.policies.cosmos import encode_prompts
from vla_attention.capture.policies.cosmos.t5_pickle import TextEmbeddings, read_embeddings
from vla_attention.capture.policies.cosmos.tensor_files import read_tensors
from vla_attention.capture.policies.cosmos.text import PieceTokenizer, PrecomputedText
from vla_attention.capture.policies.sentencepiece_model import EMBEDDED_TOKENIZER
from vla_attention.schemas.errors import UnknownName
from vla_attention.schemas.groupings.words import words_of
from vla_attention.schemas.layout import Role


class Malicious:
    """Runs a command when an unsafe reader unpickles it."""

    def __init__(self, command):
        self.command = command

    def __reduce__(self):
        return os.system, (self.command,)


def save(path, content):
    with open(path, "wb") as file:
        pickle.dump(content, file)
    return path


def made_up(count, positions=8, width=4):
    tensor = torch.zeros(1, positions, width, dtype=torch.bfloat16)
    tensor[:, :count] = 1.0
    return tensor


def test_a_malicious_pickle_is_refused_and_nothing_is_executed(tmp_path):
    trace = tmp_path / "executed"
    path = save(tmp_path / "text.pkl", {INSTRUCTION: made_up(3), "other": Malicious(f"touch {trace}")})
    with pytest.raises(UnreadableCheckpoint, match=r"text\.pkl' .* \w+\.system"):
        read_embeddings(path)
    torch.save({"net.weight": torch.zeros(1), "x": Malicious(f"touch {trace}")}, tmp_path / "weights.pt")
    with pytest.raises(UnreadableCheckpoint, match=r"weights\.pt"):
        read_tensors(tmp_path / "weights.pt")
    assert not trace.exists()
    pickle.loads(path.read_bytes())  # the file really is malicious
    assert trace.exists()


def test_nothing_but_tensors_is_looked_up(tmp_path):
    (tmp_path / "text.pkl").write_bytes(b"cbuiltins\neval\n.")
    with pytest.raises(UnreadableCheckpoint, match=r"builtins\.eval"):
        read_embeddings(tmp_path / "text.pkl")


def test_embeddings_are_read_as_saved(tmp_path):
    """In the form that is published: (1, 512, 1024) of bfloat16 by instruction."""
    saved = {"a": torch.randn(1, 512, 1024).bfloat16(), "b": made_up(2, 512, 1024)}
    found = read_embeddings(save(tmp_path / "text.pkl", saved))
    assert found.shape == (512, 1024)
    for name, tensor in saved.items():
        assert torch.equal(found.find(name), tensor)
        assert found.find(name).dtype == torch.bfloat16


@pytest.mark.parametrize("content", [b"\x80\x04\x8e" + (10**10).to_bytes(8, "little"), b"\x80\x02}r\xf0\xff\xff\xff."])
def test_a_pickle_that_asks_for_all_memory_is_refused(tmp_path, content):
    """A text of 10 GB, which the file has as a hole; and an entry of number 4 billion in a table."""
    path = tmp_path / "text.pkl"
    path.write_bytes(content)
    if content[2:3] == b"\x8e":
        os.truncate(path, 10**10 + 100)
    with pytest.raises(UnreadableCheckpoint, match=r"text\.pkl' .* 4 GB"):
        read_embeddings(path)


def test_wrapped_files_are_read(tmp_path):
    torch.save({"model": {"net.a": torch.ones(2)}}, tmp_path / "a.pt")
    assert torch.equal(read_tensors(tmp_path / "a.pt")["net.a"], torch.ones(2))


def test_an_unknown_instruction_names_the_near_ones():
    table = TextEmbeddings("x.pkl", {name: made_up(2) for name in (INSTRUCTION, "close the drawer")}, "")
    with pytest.raises(UnknownName, match=f"'pick up the blck bowl' .* 2 of 'x.pkl'.*'{INSTRUCTION}'"):
        table.find("pick up the blck bowl")
    with pytest.raises(UnknownName, match="'zzz'"):
        table.find("zzz")


def test_without_a_tokenizer_positions_are_text_or_nothing():
    text = PrecomputedText(TextEmbeddings("x", {INSTRUCTION: made_up(5)}, ""))
    encoded = text.encode(INSTRUCTION)
    assert encoded.roles.tolist() == [Role.TEXT] * 5 + [Role.NULL] * 3
    assert encoded.prompt.pieces == ()
    assert encoded.prompt.instruction_text == INSTRUCTION


def test_with_a_tokenizer_words_have_positions():
    tokenizer = PieceTokenizer(EMBEDDED_TOKENIZER)
    count = len(tokenizer.pieces(INSTRUCTION))
    table = TextEmbeddings("x", {INSTRUCTION: made_up(count + 1, count + 4), "wrong": made_up(1, count + 4)}, "")
    encoded = PrecomputedText(table, tokenizer).encode(INSTRUCTION)
    assert encoded.roles.tolist() == [Role.INSTRUCTION] * count + [Role.TEMPLATE] + [Role.NULL] * 3
    words = words_of(encoded.prompt)
    assert [word.text for word in words] == INSTRUCTION.split()
    assert sorted({key for word in words for key in word.keys}) == list(range(count))
    with pytest.raises(UnreadableCheckpoint, match=r"\b1 real positions"):
        PrecomputedText(table, tokenizer).encode("wrong")


def test_no_text_is_all_null_unless_the_file_has_an_embedding_of_it():
    embedding = made_up(2)
    without = PrecomputedText(TextEmbeddings("made up", {"open the drawer": embedding}, "0" * 64))
    assert (without.encode("").roles == Role.NULL).all()
    assert not without.encode("").embedding.any()
    assert without.encode("").embedding.dtype == embedding.dtype
    given = PrecomputedText(TextEmbeddings("made up", {"open the drawer": embedding, "": made_up(1)}, "0" * 64))
    assert (given.encode("").roles[:2] == [Role.TEXT, Role.NULL]).all()


def test_zeros_between_real_positions_are_refused():
    holed = made_up(5)
    holed[:, 2] = 0
    with pytest.raises(UnreadableCheckpoint):
        PrecomputedText(TextEmbeddings("x", {"a": holed}, "")).encode("a")


class StubEncoder:
    """A replacement of T5: every token's embedding is its id."""

    def __init__(self, folder=Path("t5")):
        self.calls, self.folder = 0, Path(folder)

    def encode(self, ids, positions, width):
        self.calls += 1
        embedding = torch.zeros(1, positions, width)
        embedding[0, : len(ids)] = torch.tensor(ids)[:, None]
        return embedding


def test_what_the_file_lacks_is_encoded_once_and_what_it_has_is_not():
    tokenizer, encoder = PieceTokenizer(EMBEDDED_TOKENIZER), StubEncoder()
    count = len(tokenizer.pieces(INSTRUCTION)) + 1
    text = PrecomputedText(TextEmbeddings("x", {INSTRUCTION: made_up(count, 32)}, ""), tokenizer, encoder)
    text.encode(INSTRUCTION)
    assert encoder.calls == 0
    for _ in range(2):
        encoded = text.encode("open the drawer")
    assert encoder.calls == 1
    assert encoded.embedding[0, :, 0].ne(0).sum() == len(encoded.prompt.pieces) + 1
    with pytest.raises(UnreadableCheckpoint, match="--t5-tokenizer"):
        PrecomputedText(text.embeddings, None, encoder)


def test_sentences_are_added_to_a_file_of_embeddings(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(encode_prompts, "T5Encoder", StubEncoder)
    shutil.copyfile(EMBEDDED_TOKENIZER, tmp_path / "spiece.model")
    old, new = save(tmp_path / "old.pkl", {INSTRUCTION: made_up(3, 32)}), tmp_path / "new.pkl"
    words = [str(old), str(new), "--t5-encoder", str(tmp_path), "--prompt", INSTRUCTION, "open the drawer"]
    assert encode_prompts.main(words) == 0
    assert "1 sentence" in capsys.readouterr().out
    found = read_embeddings(new)
    assert torch.equal(found.find(INSTRUCTION), made_up(3, 32))
    ids = PieceTokenizer(EMBEDDED_TOKENIZER).token_ids("open the drawer")
    assert found.find("open the drawer")[0, : len(ids), 0].tolist() == ids
    assert encode_prompts.main(words) == 2  # the file exists
