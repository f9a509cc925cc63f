"""Commands on hostile files, each in a fork with a limit of memory: what it says, and what it takes beyond start-up.

Libraries are imported once, before. A library that has started threads by then hangs in the forks.
"""

from __future__ import annotations

import gc
import json
import os
import resource
import signal
import sys
import time
import traceback
from collections.abc import Callable
from pathlib import Path

#: Makes a case in an empty folder; returns the arguments of `vla-attention capture` that read it.
Make = Callable[[Path], list[str]]
#: A folder of a case from which packages are imported instead of the installed ones.
PACKAGES = "packages"
#: Address space of a case.
ADDRESS_SPACE = 8 * 2**30
#: Seconds after which a case counts as hanging.
HANGS_AFTER = 60


def ready_to_fork() -> None:
    """Call this when all libraries are imported: a fork then does not copy their pages to look for garbage in them."""
    gc.collect()
    gc.freeze()


def run(make: Make, folder: Path) -> dict[str, object]:
    """Make a case and run it in a fork; returns exit code, output, seconds, bytes beyond start-up, and what it left."""
    folder.mkdir(parents=True)
    _in_a_fork(lambda: (folder / "arguments").write_text(json.dumps(make(folder))))
    arguments = json.loads((folder / "arguments").read_text())
    began = time.perf_counter()
    child = os.fork()
    if not child:
        _become_the_command(arguments, folder)
    status, usage = os.wait4(child, 0)[1:]
    return {
        "code": os.waitstatus_to_exitcode(status),
        "seconds": time.perf_counter() - began,
        "processor_seconds": usage.ru_utime + usage.ru_stime,
        "bytes": usage.ru_maxrss * 1024 - int((folder / "resident").read_text()),
        "output": (folder / "output").read_text(encoding="utf-8", errors="replace"),
        "episodes": len(list(folder.glob("store.zarr/episodes/task*"))),
    }


def resident() -> int:
    """Bytes of memory that this process has now."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize()


def _in_a_fork(make: Callable[[], object]) -> None:
    """Make a case where the libraries that it needs leave no threads behind."""
    child = os.fork()
    if not child:
        try:
            make()
        except BaseException:
            traceback.print_exc()
        finally:
            os._exit(0)
    os.waitpid(child, 0)


def _become_the_command(arguments: list[str], folder: Path) -> None:
    code = 99
    try:
        signal.alarm(HANGS_AFTER)
        resource.setrlimit(resource.RLIMIT_AS, (ADDRESS_SPACE, ADDRESS_SPACE))
        output = os.open(folder / "output", os.O_WRONLY | os.O_CREAT)
        os.dup2(output, 1)
        os.dup2(output, 2)
        if (folder / PACKAGES).is_dir():
            sys.path.insert(0, str(folder / PACKAGES))
        from vla_attention.capture.__main__ import main

        # Here, because a fork does not have the pages of libraries that it has not used.
        (folder / "resident").write_text(str(resident()))
        code = main(arguments)
    except SystemExit as error:
        code = error.code if isinstance(error.code, int) else 98
    except BaseException:
        traceback.print_exc()
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)
