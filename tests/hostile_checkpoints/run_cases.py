"""Run every hostile case as `vla-capture` in a process of its own, with a limit of memory; prints a line of JSON each.

    python -m tests.hostile_checkpoints.run_cases FOLDER [NAME ...]

Libraries are imported once, and each case is a fork: what it takes beyond start-up is its peak of resident memory less
what it has when it begins.
"""

from __future__ import annotations

import json
import os
import resource
import signal
import sys
import time
import traceback
from collections.abc import Callable
from pathlib import Path

from tests.hostile_checkpoints.cosmos_cases import COSMOS, dummy
from tests.hostile_checkpoints.hostile_files import TRACE, Case
from tests.hostile_checkpoints.libero_cases import LIBERO, PACKAGES, PARITY
from tests.hostile_checkpoints.pi_cases import PI

CASES: dict[str, Case] = {
    f"{family}: {name}": case
    for family, cases in (("pi", PI), ("cosmos", COSMOS), ("libero", LIBERO), ("parity", PARITY))
    for name, case in cases.items()
}
#: Address space of a case.
ADDRESS_SPACE = 8 * 2**30
#: Seconds after which a case counts as hanging.
HANGS_AFTER = 60


def resident() -> int:
    """Bytes of memory that this process has now."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize()


def run(name: str, folder: Path) -> dict[str, object]:
    """Make a case and run it in a fork; returns exit code, output, seconds, bytes beyond start-up, and what it left."""
    folder.mkdir(parents=True)
    _in_a_fork(lambda: (folder / "arguments").write_text(json.dumps(CASES[name].make(folder))))
    arguments = json.loads((folder / "arguments").read_text())
    began = time.perf_counter()
    child = os.fork()
    if not child:
        _become_the_command(arguments, folder)
    status, usage = os.wait4(child, 0)[1:]
    return {
        "name": name,
        "code": os.waitstatus_to_exitcode(status),
        "seconds": time.perf_counter() - began,
        "processor_seconds": usage.ru_utime + usage.ru_stime,
        "bytes": usage.ru_maxrss * 1024 - int((folder / "resident").read_text()),
        "output": (folder / "output").read_text(encoding="utf-8", errors="replace"),
        "executed": (folder / TRACE).exists(),
        "episodes": len(list(folder.glob("store.zarr/episodes/task*"))),
    }


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


def _import_everything() -> None:
    """What the commands import when they run, so that a fork has it."""
    import diffusers.models.autoencoders.autoencoder_kl_wan  # noqa: F401
    import torch
    import zarr  # noqa: F401

    import vla_attention.capture.capture_run
    import vla_attention.capture.policies.cosmos.build
    import vla_attention.capture.policies.cosmos.parity
    import vla_attention.capture.policies.pi.build  # noqa: F401
    from vla_attention.capture.environments.robosuite_installation import import_robosuite

    torch.set_num_threads(1)
    import_robosuite()  # half a second of each case of LIBERO
    dummy()


def main(argv: list[str]) -> int:
    """Run the named cases, or all."""
    folder, names = Path(argv[0]), argv[1:] or list(CASES)
    _import_everything()
    for number, name in enumerate(names):
        print(json.dumps(run(name, folder / f"{number:03d}")), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
