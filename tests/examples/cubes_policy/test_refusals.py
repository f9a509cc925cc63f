"""What `demonstrate`, `train` and `export` refuse: one sentence and exit code 2, before anything is made."""

from __future__ import annotations

import pytest

from examples.cubes_policy.__main__ import main
from tests.kit.stores import write_store


@pytest.mark.parametrize(
    ("given", "said"),
    [
        (["demonstrate", "a_file"], "Cannot make the folder 'a_file' for the demonstrations (File exists)"),
        (["train", "new", "out", "--tasks", "0"], "--tasks 0; expected 1 to"),
        (["export", "new", "out"], "'new' has no checkpoint.pt"),
    ],
)
def test_a_mistake_is_one_sentence(given, said, folder, tmp_path, monkeypatch, capsys) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "a_file").write_text("text")
    assert main([str(folder) if word == "FOLDER" else word for word in given]) == 2
    error = capsys.readouterr().err
    assert said in error
    assert error.count("\n") == 1
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a_file"]


def test_nothing_is_written_into_a_store(folder, tmp_path, capsys) -> None:
    inside = write_store(tmp_path / "a.zarr") / "output"
    for given in (["demonstrate"], ["train", str(folder)]):
        assert main([*given, str(inside)]) == 2
        assert "is inside of the store" in capsys.readouterr().err
        assert not inside.exists()
