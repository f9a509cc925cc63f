"""A second process draws what this one would draw, and where there is none, this one does."""

from __future__ import annotations

import os
from concurrent.futures import ProcessPoolExecutor

import pytest
from matplotlib.figure import Figure

from tests.analyze.conftest import DRAW
from tests.kit.episode_work import defect, die_once, process_of, square
from vla_attention.analyze.__main__ import main
from vla_attention.analyze.stores.second_process import SecondProcess
from vla_attention.testing.stores import write_store


@pytest.fixture
def two_threads(monkeypatch) -> None:
    monkeypatch.setenv("OMP_NUM_THREADS", "2")


@pytest.mark.drawn
def test_pictures_are_the_same_from_another_process(tmp_path, two_threads, monkeypatch):
    monkeypatch.setattr(Figure, "savefig", DRAW)
    store = write_store(tmp_path / "a.zarr")
    here, there = tmp_path / "here", tmp_path / "there"
    started = []
    submit = ProcessPoolExecutor.submit
    monkeypatch.setattr(ProcessPoolExecutor, "submit", lambda *given: started.append(given[1]) or submit(*given))
    for folder, threads in ((here, "1"), (there, "2")):
        assert not started
        assert main([str(store), "--output", str(folder), "--threads", threads]) == 0
    assert [function.__name__ for function in started] == ["_load", "write_plots"]
    pictures = [path.name for path in here.iterdir() if path.suffix in (".png", ".csv")]
    assert len(pictures) >= 8
    assert {path.name for path in there.iterdir()} == {path.name for path in here.iterdir()}
    for name in pictures:
        assert (there / name).read_bytes() == (here / name).read_bytes()


def test_several_functions_one_after_the_other(two_threads):
    with SecondProcess(("json",)) as second:
        results = [second.begin(square, 3), second.begin(process_of, 0)]
        assert results[0]() == 9
        assert results[1]() != os.getpid()


@pytest.mark.parametrize(("modules", "threads"), [((), "2"), (("json",), "1")])
def test_without_one_the_work_is_done_here(monkeypatch, modules, threads):
    monkeypatch.setenv("OMP_NUM_THREADS", threads)
    with SecondProcess(modules) as second:
        assert second.begin(process_of, 0)() == os.getpid()


def test_a_system_without_further_processes(two_threads, monkeypatch):
    def refuse(*_: object, **__: object) -> None:
        raise OSError(38, "Function not implemented")

    monkeypatch.setattr("vla_attention.analyze.stores.second_process.ProcessPoolExecutor", refuse)
    with SecondProcess(("json",)) as second:
        assert second.begin(process_of, 0)() == os.getpid()


def test_what_a_process_leaves_when_it_dies_is_done_here(tmp_path, two_threads):
    with SecondProcess(("json",)) as second:
        first = second.begin(die_once, 3, tmp_path / "died")
        assert first() == 3
        assert second.begin(process_of, 0)() == os.getpid()


def test_errors_come_back(two_threads):
    with SecondProcess(("json",)) as second, pytest.raises(ZeroDivisionError, match="a defect at 4"):
        second.begin(defect, 4)()
