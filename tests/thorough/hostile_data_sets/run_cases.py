"""Run every hostile data set through `capture replay` in a process of its own; prints a line of JSON each.

python -m tests.thorough.hostile_data_sets.run_cases FOLDER [NAME ...]
"""

from __future__ import annotations

import json
import shutil
import sys
from pathlib import Path

from tests.thorough import hostile_runs
from tests.thorough.hostile_data_sets.made import Case, good
from tests.thorough.hostile_data_sets.meta_cases import META
from tests.thorough.hostile_data_sets.picture_cases import PICTURES
from tests.thorough.hostile_data_sets.table_cases import TABLES
from tests.thorough.hostile_data_sets.video_cases import VIDEOS
from tests.thorough.hostile_runs import Make

CASES: dict[str, Case] = {
    f"{kind}: {name}": case
    for kind, cases in (("meta", META), ("table", TABLES), ("picture", PICTURES), ("video", VIDEOS))
    for name, case in cases.items()
}
#: Data sets that are replayed: what the others take is more than these.
GOOD: dict[str, Make] = {
    "good: v2.1": good("v2.1", video=False),
    "good: v3.0": good("v3.0", video=False),
    "good: video": good("v2.1", video=True),
}


def _import_everything() -> None:
    """What the command imports when it runs, so that a fork has it. Nothing is computed: threads would be lost."""
    import av  # noqa: F401
    import polars  # noqa: F401
    import torch
    import zarr  # noqa: F401

    import vla_attention.capture.policies.pi.loading
    import vla_attention.capture.replay.command
    import vla_attention.capture.replay.family_replay  # noqa: F401

    torch.set_num_threads(1)
    with torch.device("meta"):
        torch.nn.Embedding(2, 2)  # two seconds of imports, which each case would take that builds a model


def main(argv: list[str]) -> int:
    """Run the named cases, or all."""
    folder, makes = Path(argv[0]), {**GOOD, **{name: case.make for name, case in CASES.items()}}
    _import_everything()
    hostile_runs.ready_to_fork()
    for number, name in enumerate(argv[1:] or makes):
        here = folder / f"{number:03d}"
        print(json.dumps({"name": name, **hostile_runs.run(makes[name], here)}), flush=True)
        shutil.rmtree(here)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
