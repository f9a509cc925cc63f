"""Make golden stores and the numbers that they must give: python -m tests.golden.make_stores FOLDER

Once the format is frozen they stay as they are: today's code has to give the same numbers
(`tests/schemas/stores/test_golden_stores.py`). FOLDER is empty or new.
"""

from __future__ import annotations

import shutil
import sys
from pathlib import Path

import pytest

from tests.kit.golden_stores import NAMES, write_tables
from tests.kit.small_torch_policy import SmallPolicy, given, small_layout
from tests.kit.still_scene import capture_without_simulator
from tests.kit.stores import small_steps, write_store
from tests.kit.uniform_cases import TABLE, write_case
from vla_attention.capture.__main__ import main as capture
from vla_attention.capture.torch_policies.record import record
from vla_attention.schemas.stores.tar_files import write_tar

_WHERE = ("--checkpoint", "untrained-tiny", "--task-suite", "robosuite", "--task-id", "0", "1", "--num-episodes", "1")


def make_stores(folder: Path) -> None:
    """Write the stores and their tables into a folder."""
    folder.mkdir(parents=True, exist_ok=True)
    with pytest.MonkeyPatch.context() as patch:
        capture_without_simulator(patch)
        _run("pi", *_WHERE, "--max-steps", "10", "--output", str(folder / "joint.zarr"))
        cosmos = ("--max-steps", "20", "--query-frame", "curr_last", "--no-frames")
        _run("cosmos", *_WHERE, *cosmos, "--output", str(folder / "cosmos.zarr"))
    _record(folder / "library.zarr")
    changes = ("--check", "0", "--knockout", "camera:base_0_rgb", "--knockout-queries", "action")
    _run("rerun", str(folder / "joint.zarr"), *changes, "--output", str(folder / "rerun.zarr"))
    effects = ("--effects", "text,objects", "--effects-readers", "all", "action", "pictures", "text", "--check", "0")
    little = ("--layers", "0", "--denoise", "last", "--no-frames", "--no-contributions")
    _run("rerun", str(folder / "joint.zarr"), *effects, *little, "--output", str(folder / "effects.zarr"))
    (masks,) = (case for case in TABLE["stored"] if case["name"] == "masks differ along every axis")
    write_case(folder / "masks.zarr", masks, masks["weights"])
    write_store(
        folder / "steps.zarr", tasks=(0,), replans=2, layers=(0,), heads=(0,), frames=False, plant_steps=small_steps
    )
    for name in NAMES:
        write_tables(folder / f"{name}.zarr", folder / name)
        write_tar(folder / f"{name}.zarr", folder / f"{name}.tar.xz")
        shutil.rmtree(folder / f"{name}.zarr")


def _run(*words: str) -> None:
    code = capture(list(words))
    if code:
        sys.exit(code)


def _record(path: Path) -> None:
    """Two episodes of the caller's own policy, in the caller's own loop."""
    policy = SmallPolicy()
    settings = {"layout": small_layout(), "tokenizer": policy.tokenizer, "denoise_steps": "all"}
    with record(path, policy, **settings) as run:
        for number, text in enumerate(("pick the bowl", "pick up the plate")):
            with run.episode(task_id=number, episode_index=0, instruction=text, seed=7) as episode:
                for step in range(2):
                    inputs = given(seed=10 * number + step, text=text)
                    facts = {"frames": {"front": inputs["pictures"]}, "state": inputs["states"]}
                    with episode.replan(env_step=5 * step, **facts) as replan:
                        replan.actions = policy.act(**inputs)
                episode.success = number == 0


if __name__ == "__main__":
    make_stores(Path(sys.argv[1]))
