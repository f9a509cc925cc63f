"""Run every hostile case as `capture` in a process of its own, with a limit of memory; prints a line of JSON each.

    python -m tests.thorough.hostile_checkpoints.run_cases FOLDER [NAME ...]

Libraries are imported once, and each case is a fork; see `tests.thorough.hostile_runs`.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

from tests.thorough import hostile_runs
from tests.thorough.hostile_checkpoints.cosmos_cases import COSMOS, dummy
from tests.thorough.hostile_checkpoints.hostile_files import TRACE, Case
from tests.thorough.hostile_checkpoints.libero_cases import LIBERO
from tests.thorough.hostile_checkpoints.pi_cases import PI

CASES: dict[str, Case] = {
    f"{family}: {name}": case
    for family, cases in (("pi", PI), ("cosmos", COSMOS), ("libero", LIBERO))
    for name, case in cases.items()
}


def run(name: str, folder: Path) -> dict[str, object]:
    """Run a case; beside what the kit finds, whether something of its files was executed."""
    return {"name": name, **hostile_runs.run(CASES[name].make, folder), "executed": (folder / TRACE).exists()}


def _import_everything() -> None:
    """What the commands import when they run, so that a fork has it."""
    import diffusers.models.autoencoders.autoencoder_kl_wan  # noqa: F401
    import torch
    import zarr  # noqa: F401

    from vla_attention.capture.environments.robosuite_installation import import_robosuite

    torch.set_num_threads(1)
    import_robosuite()  # half a second of each case of LIBERO
    dummy()


def main(argv: list[str]) -> int:
    """Run the named cases, or all."""
    folder, names = Path(argv[0]), argv[1:] or list(CASES)
    _import_everything()
    hostile_runs.ready_to_fork()
    for number, name in enumerate(names):
        print(json.dumps(run(name, folder / f"{number:03d}")), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
