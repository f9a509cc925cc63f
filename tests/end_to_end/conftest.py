"""Stores made by the real command line in the real simulator, once per session."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from vla_attention.capture.__main__ import main as capture

#: The policy of test size gives four actions a call.
DUMMY = (
    "pi",
    "--checkpoint",
    "untrained-tiny",
    "--task-suite",
    "robosuite",
    "--replan-steps",
    "4",
    "--max-steps",
    "12",
    "--num-envs",
    "1",  # a simulator in a process of its own imports everything again
)


@contextmanager
def drawing_is_not_asked() -> Iterator[None]:
    """tests/capture/environments/test_drawing.py asks; each time a new process imports everything and draws."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("vla_attention.capture.environments.drawing.check_drawing", lambda suite, libero_assets: "")
        yield


@pytest.fixture(scope="module", autouse=True)  # not of the session, whose other tests would find it changed
def _drawing_is_not_asked() -> Iterator[None]:
    with drawing_is_not_asked():
        yield


@pytest.fixture(scope="session")
def run_capture() -> Callable[..., None]:
    """Run `capture pi` with the tiny policy and further arguments; anything but success fails the test."""

    def run(*arguments: object) -> None:
        with drawing_is_not_asked():
            assert capture([*DUMMY, *map(str, arguments)]) == 0

    return run


@pytest.fixture(scope="session")
def captured_store(run_capture: Callable[..., None], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two built-in tasks with two episodes each; the second command resumes the store of the first."""
    store = tmp_path_factory.mktemp("captured") / "robosuite.zarr"
    run_capture("--task-id", 0, "--num-episodes", 2, "--output", store)
    run_capture("--task-id", 1, "--num-episodes", 2, "--output", store, "--resume")
    return store
