"""What all tests share: one thread, which of them run, how many random examples they try, zarr, LIBERO's assets."""

from __future__ import annotations

import asyncio
import os
import shutil
import signal
import sys
import threading
import weakref
from collections import defaultdict
from collections.abc import Callable, Coroutine, Iterator
from concurrent.futures import Future
from pathlib import Path
from typing import Any

import pytest
from hypothesis import settings

from tests.kit.examples import PROFILES
from tests.kit.jitter import jitter
from vla_attention.schemas.threads import use_threads

# Before a test module imports torch or numpy: several threads make small models slower. OMP_NUM_THREADS overrides.
os.environ.setdefault("OMP_NUM_THREADS", "1")
use_threads()
# What is tested is measured; tests of the cache switch it on in a folder of their own. Subprocesses inherit it.
os.environ["VLA_CACHE"] = "off"
# Shells start programs in the background with Ctrl-C ignored, and subprocesses inherit that: tests that give it would
# wait.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

# The gate draws the same examples at every run: a change is held against its own faults.
for _name, _count in PROFILES.items():
    settings.register_profile(_name, max_examples=_count, deadline=None, derandomize=_name == "fast")
# `pytest --hypothesis-profile thorough` loads the other one afterwards, and before test modules are imported.
settings.load_profile("fast")


#: Attacks.
THOROUGH = Path(__file__).with_name("thorough")

#: Where temporary folders go if it has this much room: files in memory take a third of the time of those on a disk.
_MEMORY, _ROOM = Path("/dev/shm"), 4 << 30
if _MEMORY.is_dir() and os.access(_MEMORY, os.W_OK) and shutil.disk_usage(_MEMORY).free >= _ROOM:
    os.environ.setdefault("PYTEST_DEBUG_TEMPROOT", str(_MEMORY))


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--thorough", action="store_true", help="run what make test-thorough runs too")
    parser.addoption("--jitter", action="store_true", help="change the last bits of sums: see tests/kit/jitter")


def pytest_configure(config: pytest.Config) -> None:
    # `-m thorough`, alone or in an expression, asks for these tests as well.
    config.option.thorough = config.option.thorough or "thorough" in config.option.markexpr
    if config.option.jitter:
        jitter.switch_on()


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """Leave the folder out: importing its hundreds of cases takes seconds. Named on the command line, it is wanted."""
    named = any(collection_path.resolve() in (path, *path.parents) for path in map(_named, config.args))
    return None if config.option.thorough or named or collection_path != THOROUGH else True


def _named(argument: str) -> Path:
    return Path(argument.split("::")[0]).resolve()


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    for item in items:
        if item.path.is_relative_to(THOROUGH):
            item.add_marker(pytest.mark.thorough)
    if config.option.thorough:
        return
    left_out = [item for item in items if item.get_closest_marker("thorough")]
    if left_out:
        config.hook.pytest_deselected(items=left_out)
        items[:] = [item for item in items if item not in set(left_out)]


@pytest.fixture(scope="session", autouse=True)
def _zarr_works_without_threads() -> Iterator[None]:
    """zarr hands every call to a thread with its loop, and every chunk to a pool: half of the time of small chunks."""
    from zarr.core import sync  # after `use_threads`, which numpy reads

    async def call(function: Callable[..., Any], /, *arguments: Any, **options: Any) -> Any:
        return function(*arguments, **options)

    def run_here(work: Coroutine[Any, Any, Any], loop: asyncio.AbstractEventLoop) -> Future[Any]:
        if loop is not sync.loop[0] or asyncio.events._get_running_loop() is not None:
            return in_its_thread(work, loop)
        if getattr(own, "process", None) != os.getpid():  # a forked process does not share its parent's loop
            own.process, own.loop = os.getpid(), asyncio.new_event_loop()
        done: Future[Any] = Future()
        done.set_result(own.loop.run_until_complete(work))
        return done

    own, in_its_thread = threading.local(), asyncio.run_coroutine_threadsafe
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(asyncio, "to_thread", call)
        patch.setattr(asyncio, "run_coroutine_threadsafe", run_here)
        yield


@pytest.fixture(scope="session", autouse=True)
def _readers_of_foreign_files_are_kept() -> Iterator[None]:
    """Some import torch, which takes two seconds: what one reader has closed serves the next one of the same limits."""
    from vla_attention.schemas import bounded_process
    from vla_attention.schemas.bounded_process import BoundedProcess

    idle: dict[tuple[object, ...], list[dict[str, Any]]] = defaultdict(list)
    begin, end = BoundedProcess._start, BoundedProcess.close

    def kind(one: BoundedProcess) -> tuple[object, ...]:
        return (os.getpid(), one._most_bytes, one._processor_seconds, *map(str, sys.path))

    def start(self: BoundedProcess) -> bool:
        if self._end is None and idle[kind(self)]:
            vars(self).update(idle[kind(self)].pop())
            self._end = weakref.finalize(self, bounded_process._end, self._process, self._connection, self._owner)
        return begin(self)

    def close(self: BoundedProcess) -> None:
        # Within a call it is closed because of what the file did to it.
        if self._end is None or self._one_at_a_time.locked() or self._process.poll() is not None:
            return end(self)
        self._end.detach()
        self._end = None
        idle[kind(self)].append({name: vars(self)[name] for name in ("_connection", "_process", "_owner")})
        return None

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(BoundedProcess, "_start", start)
        patch.setattr(BoundedProcess, "close", close)
        yield


@pytest.fixture(scope="session", autouse=True)
def _nothing_is_flushed_to_the_disk() -> Any:
    """No test can cut the power. An episode has some forty files and folders, at a millisecond or more each."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(os, "fsync", lambda _handle: None)
        yield


@pytest.fixture
def usual_signals() -> Iterator[None]:
    """Python's own handling of Ctrl-C and SIGTERM, whatever libraries and tests before have made of it."""
    usual = {signal.SIGINT: signal.default_int_handler, signal.SIGTERM: signal.SIG_DFL}
    before = {number: signal.signal(number, handler) for number, handler in usual.items()}
    yield
    for number, handler in before.items():
        if handler is not None:  # None: not set by Python, which cannot set it again
            signal.signal(number, handler)


@pytest.fixture(scope="session")
def libero_assets() -> Path:
    """The LIBERO asset folder: VLA_LIBERO_ASSETS, else ../shared/libero-assets beside the checkout, else skip."""
    given = os.environ.get("VLA_LIBERO_ASSETS")
    if given:
        return Path(given)
    beside = Path(__file__).resolve().parents[2] / "shared" / "libero-assets"
    if beside.is_dir():
        return beside
    pytest.skip("no LIBERO assets: set VLA_LIBERO_ASSETS to the asset folder")
