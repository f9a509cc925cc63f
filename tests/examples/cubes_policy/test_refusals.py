"""What `demonstrate`, `train` and `export` refuse: one sentence and exit code 2, before anything is made."""

from __future__ import annotations

import pytest

from examples.cubes_policy.__main__ import main
from tests.kit.stores import write_store


@pytest.mark.parametrize(
    ("given", "named"),
    [
        (["demonstrate", "a_file"], "'a_file'"),
        (["train", "new", "out", "--tasks", "0"], "--tasks 0; "),
        (["export", "new", "out"], "checkpoint.pt"),
    ],
)
def test_a_mistake_is_named_in_one_line(given, named, folder, tmp_path, monkeypatch, capsys) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "a_file").write_text("text")
    assert main([str(folder) if word == "FOLDER" else word for word in given]) == 2
    error = capsys.readouterr().err
    assert named in error
    assert error.count("\n") == 1
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a_file"]


def test_nothing_is_written_into_a_store(folder, tmp_path, capsys) -> None:
    inside = write_store(tmp_path / "a.zarr") / "output"
    for given in (["demonstrate"], ["train", str(folder)]):
        assert main([*given, str(inside)]) == 2
        assert ".zarr" in capsys.readouterr().err
        assert not inside.exists()
