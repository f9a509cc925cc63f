"""How often a command decodes each chunk of the rows: once, and none that it does not need."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import pytest

import vla_attention as va
from tests.capture.store.test_disk_estimate import large_tokens
from tests.kit.stores import write_store
from vla_attention.__main__ import main
from vla_attention.schemas.stores.stored_array import StoredArray

Chunks = Counter[tuple[str, int]]


@pytest.fixture
def decoded(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Chunks:
    """(episode's folder, number) of the chunks of rows that are decoded from now on; nothing is cached."""
    monkeypatch.setenv("VLA_CACHE", "off")
    monkeypatch.chdir(tmp_path)
    chunks: Chunks = Counter()
    one = StoredArray._decode

    def counted(self, number, *rest):
        if self.name.endswith("/rows"):
            chunks[str(self.files.source.path), number] += 1
        return one(self, number, *rest)

    monkeypatch.setattr(StoredArray, "_decode", counted)
    return chunks


@pytest.mark.parametrize(
    ("words", "most"),
    [
        ("analyze CUBES --group thing=word:cube --group seen=role:image --ratio seen/thing", 1),
        ("analyze CUBES --by layer,head", 0),  # whole segments are stored
        ("analyze CUBES --without-sinks", 2),  # once to find them, once without them
        ("words CUBES", 1),
        ("objects CUBES", 1),
        ("overlay CUBES", 1),
        ("language CUBES", 1),
        ("failures OTHER --twins CUBES", 1),
        ("effects CUBES", 1),
        ("compare CUBES OTHER", 1),
        ("compare CUBES NOISE", 1),
        # Once for pictures, words and heads, once for what effects are of.
        ("view CUBES --file page.html", 2),
        ("view CUBES --file page.html --heads", 2),
        # Every question that reads rows reads them: words, objects, effects, language and overlay.
        ("report CUBES", 5),
    ],
)
def test_each_chunk_is_decoded_once(decoded, words, most, capsys):
    stores = {"CUBES": "cubes", "OTHER": "cubes_one_colour", "NOISE": "cubes_noise"}
    given = [str(va.example(stores[word])) if word in stores else word for word in words.split()]
    plain = ["--no-plots"] if given[0] not in ("view", "report") else []
    assert main([*given, *plain]) == 0, capsys.readouterr().err
    assert max(decoded.values(), default=0) == most


@pytest.mark.parametrize(
    ("group", "chunks"),
    [("word:bowl", {2}), ("patch:wrist[0:2,0:2]", {1}), ("role:image", set()), ("keys:3-700", {0, 1, 2})],
)
def test_a_question_reads_the_chunks_of_its_keys(decoded, tmp_path, group, chunks):
    """Of 800 keys the base camera has a chunk, the wrist camera one, and prompt and actions one."""
    path = write_store(tmp_path / "a.zarr", tokens=large_tokens(9), tasks=(0,), episodes=1)
    decoded.clear()
    assert main(["analyze", str(path), "--group", f"own={group}", "--no-plots"]) == 0
    assert {number % 3 for _, number in decoded} == chunks
