"""Programs that are told to stop at a chosen moment, in processes of their own; no test waits for a moment to come."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Sequence

#: `stop()` gives the signal to the whole group of processes, as a terminal does.
_PROGRAM = """
import os, runpy, signal, sys

def stop():
    for _ in range({times}):
        os.killpg(0, signal.{signal})

class AtImport:
    def __init__(self, name):
        self.name = name

    def find_spec(self, name, path=None, target=None):
        if name == self.name:
            sys.meta_path.remove(self)
            stop()

{moment}
sys.argv = {argv!r}
runpy.run_module({module!r}, run_name="__main__")
"""


def at_import(name: str) -> str:
    """The moment at which a module is imported, as code for `run_stopped`."""
    return f"sys.meta_path.insert(0, AtImport({name!r}))"


def after_call(module: str, owner: str, name: str) -> str:
    """The moment at which a function has returned for the first time; owner: its class, or nothing."""
    of_owner = f"module.{owner}" if owner else "module"
    return f"""
import importlib
module = importlib.import_module({module!r})
owner, told = {of_owner}, []
original = getattr(owner, {name!r})

def stopped(*arguments, **keywords):
    result = original(*arguments, **keywords)
    if not told:
        told.append(True)
        stop()
    return result

setattr(owner, {name!r}, stopped)
"""


def run_stopped(
    module: str, arguments: Sequence[str], moment: str, signal: str = "SIGINT", times: int = 1
) -> subprocess.CompletedProcess[str]:
    """Run `python -m module arguments`, and give a signal to it and its children at a moment."""
    code = _PROGRAM.format(times=times, signal=signal, moment=moment, argv=[module, *arguments], module=module)
    return subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=False, start_new_session=True, timeout=120
    )
