"""The policies of the validation, and the stores of their rollouts."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from vla_attention.capture.__main__ import main as capture
from vla_attention.schemas.errors import BadArgument
from vla_attention.schemas.stores.reader import Store, open_store

#: The suite in which each control was trained (`examples/cubes_policy/dataset.py`).
SUITES = {"words": "cubes", "redundant": "cubes_marked", "mark": "cubes_mark_only", "no-wrist": "cubes"}
#: In place of a control: `pi05_cubes`, which was trained longer and on more tasks.
SHIPPED = "shipped"
#: What the page calls the controls.
TITLES = {
    SHIPPED: "shipped",
    "words": "must read",
    "redundant": "need not read",
    "mark": "cannot read",
    "no-wrist": "no wrist camera",
}


@dataclass(frozen=True)
class KnownPolicy:
    """A trained policy. control: what it could learn from, one of `TITLES`."""

    name: str
    checkpoint: str
    suite: str
    control: str
    seed: int = 0


def read_policies(folder: Path) -> list[KnownPolicy]:
    """The checkpoints in a folder: sub-folders that `examples.cubes_policy export` wrote, by control and seed."""
    found = []
    for card in sorted(folder.glob("*/card.json")):
        facts = json.loads(card.read_text(encoding="utf-8"))
        control = facts["control"]
        found.append(KnownPolicy(card.parent.name, str(card.parent), SUITES[control], control, int(facts["seed"])))
    if not found:
        raise BadArgument(
            f"The folder {folder} holds no checkpoint with a card.json; expected folders of `python -m "
            "examples.cubes_policy export`."
        )
    return sorted(found, key=lambda policy: (list(SUITES).index(policy.control), policy.seed))


def record(policy: KnownPolicy, store: Path, tasks: list[int], max_steps: int, *further: str) -> Store:
    """Record a rollout of each task, or go on with them, and open the store."""
    arguments = ["pi", "--checkpoint", policy.checkpoint, "--task-suite", policy.suite, "--output", str(store)]
    arguments += ["--num-episodes", "1", "--threads", "1", "--max-steps", str(max_steps)]
    arguments += ["--task", *map(str, tasks), *(["--resume"] if store.exists() else [])]
    if capture([*arguments, *further]):
        raise SystemExit(f"the capture into {store} failed")
    return open_store(store)


def load_policy(store: Path) -> Any:
    """The policy of a store, rebuilt as `vla-attention capture rerun` does it."""
    import argparse

    from vla_attention.capture.machine import load_torch
    from vla_attention.capture.rerun.arguments import add_rerun_arguments

    parser = argparse.ArgumentParser()
    add_rerun_arguments(parser, [str(store)])
    arguments = parser.parse_args([str(store)])
    return arguments.family.read(arguments).build(load_torch(arguments.device, 1))


def success(store: Store) -> dict[str, int]:
    """Number of episodes and of those solved."""
    solved = [bool(episode.attributes.success) for episode in store.episodes]
    return {"episodes": len(solved), "solved": sum(solved)}
