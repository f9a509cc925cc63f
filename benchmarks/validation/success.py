"""Success under interventions: rollouts with tokens hidden, another prompt, or a grey picture."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

from benchmarks.validation.changes import BASE_CAMERA, NEXT_COLOUR, WRIST_CAMERA
from benchmarks.validation.policies import SHIPPED, KnownPolicy, record, success

#: What is changed -> options of `vla-attention capture pi`, and the kinds of policies that are tried.
CONDITIONS: dict[str, tuple[tuple[str, ...], tuple[str, ...]]] = {
    "an empty prompt": (("--prompt", "empty"), (SHIPPED, "words", "redundant", "mark")),
    "another colour named": (("--prompt", "synonyms:{synonyms}"), (SHIPPED, "redundant")),
    "the instruction hidden from the action tokens": (
        ("--knockout", "role:instruction", "--knockout-queries", "action"),
        (SHIPPED,),
    ),
    "the instruction hidden from all tokens": (("--knockout", "role:instruction"), (SHIPPED,)),
    "the agent camera hidden from all tokens": (("--knockout", f"camera:{BASE_CAMERA}"), (SHIPPED,)),
    "the agent camera grey": (("--image", f"{BASE_CAMERA}=blank"), (SHIPPED,)),
    "the wrist camera hidden from all tokens": (("--knockout", f"camera:{WRIST_CAMERA}"), (SHIPPED,)),
    "the wrist camera grey": (("--image", f"{WRIST_CAMERA}=blank"), (SHIPPED, "no-wrist")),
}
#: What a rollout for its outcome alone does not record.
_LIGHT = ("--layers", "0", "--heads", "0", "--denoise", "last", "--no-contributions", "--no-frames")


def success_under(
    policy: KnownPolicy, folder: Path, tasks: list[int], max_steps: int, say: Callable[[str], None]
) -> list[dict[str, Any]]:
    """Rows of policy, control, condition, episodes and solved, of the first training of each kind."""
    folder.mkdir(parents=True, exist_ok=True)
    synonyms = folder / "other_colours.json"
    synonyms.write_text(json.dumps(NEXT_COLOUR), encoding="utf-8")
    found = []
    for number, (condition, (options, kinds)) in enumerate(CONDITIONS.items()):
        if policy.control not in kinds or policy.seed:
            continue
        say(f"{policy.name}: {condition}")
        given = [option.format(synonyms=synonyms) for option in options]
        store = record(policy, folder / f"success_{number}.zarr", tasks, max_steps, *_LIGHT, *given)
        found.append({"policy": policy.name, "control": policy.control, "condition": condition} | success(store))
    return found
