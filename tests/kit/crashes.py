"""Processes that die at a chosen moment, and calls that fail. They are injected; the product knows nothing of them."""

from __future__ import annotations

import multiprocessing
import os
import signal
from collections.abc import Callable
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from vla_attention.capture.store.unpublished import UnpublishedFolder

#: Processes that have imported everything and started no thread yet, so that a child is there at once.
PROCESSES = multiprocessing.get_context("forkserver")
PROCESSES.set_forkserver_preload(["tests.kit.stores", "vla_attention.analyze.store.merging"])


@contextmanager
def before_call(kind: str, number: int, action: Callable[[], None]):
    """Act before the number-th (from 0) call of a kind: `set` (a file), `fsync`, `rename`.

    "renamed" and "replaced": after one.
    """
    owner: Any = {"set": UnpublishedFolder, "fsync": os}.get(kind, Path)
    name = kind.removesuffix("d")
    original = getattr(owner, name)
    calls = 0

    def note() -> None:
        nonlocal calls
        calls += 1
        if calls == number + 1:
            action()

    async def noted_set(self, *arguments, **keywords):
        note()
        return await original(self, *arguments, **keywords)

    def noted(*arguments, **keywords):
        if not kind.endswith("d"):
            note()
        result = original(*arguments, **keywords)
        if kind.endswith("d"):
            note()
        return result

    setattr(owner, name, noted_set if kind == "set" else noted)
    try:
        yield lambda: calls
    finally:
        setattr(owner, name, original)


def die() -> None:
    """End this process as SIGKILL does."""
    os.kill(os.getpid(), signal.SIGKILL)


def run_child(target: Callable[..., None], *arguments: Any) -> int | None:
    """Run a function in a process of its own; returns the exit code, negative for a signal."""
    child = PROCESSES.Process(target=target, args=arguments)
    child.start()
    child.join(60)
    assert child.exitcode is not None, "the child hangs"
    return child.exitcode
