"""Success under interventions: rollouts of a policy with a group of keys knocked out, another prompt, or no picture."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from benchmarks.validation.changes import NEXT_COLOUR
from benchmarks.validation.policies import KnownPolicy, record, success

#: Name -> options of `vla-capture`. The first and the last camera of the small policy are the agent's and the wrist's.
CONDITIONS: dict[str, tuple[str, ...]] = {
    "nothing changed": (),
    "prompt empty": ("--prompt", "empty"),
    "without the instruction's words": ("--knockout", "role:instruction", "--knockout-queries", "action"),
    "... for all queries": ("--knockout", "role:instruction"),
    "another colour named": ("--prompt", "synonyms:{synonyms}"),
    "without the agent camera, all queries": ("--knockout", "camera:{first}"),
    "agent camera blank": ("--image", "{first}=blank"),
    "without the wrist camera, all queries": ("--knockout", "camera:{last}"),
    "wrist camera blank": ("--image", "{last}=blank"),
}
#: Of controls, and of their first seed, only these: they say on what success depends.
CONTROL_CONDITIONS = {
    "words": ("prompt empty",),
    "redundant": ("prompt empty", "another colour named"),
    "mark": ("prompt empty",),
    "no-wrist": ("wrist camera blank",),
}


def success_under(
    policy: KnownPolicy,
    cameras: Sequence[str],
    folder: Path,
    tasks: list[int] | None,
    episodes: int,
    max_steps: int | None,
    conditions: tuple[str, ...],
    say: Callable[[str], None],
) -> list[dict[str, Any]]:
    """Rollouts under each condition; rows of policy, condition, episodes, solved."""
    folder.mkdir(parents=True, exist_ok=True)
    synonyms = folder / "other_colours.json"
    synonyms.write_text(json.dumps(NEXT_COLOUR), encoding="utf-8")
    found = []
    for number, name in enumerate(CONDITIONS):
        # Only sentences of the suites of cubes name a colour, and the constant one of a control does not.
        if (
            name not in conditions
            or ("colour" in name and "cubes" not in policy.suite)
            or ("colour" in name and policy.control == "mark")
        ):
            continue
        say(f"{policy.name}: {name}")
        options = [option.format(synonyms=synonyms, first=cameras[0], last=cameras[-1]) for option in CONDITIONS[name]]
        light = ["--layers", "0", "--heads", "0", "--denoise", "last", "--no-contributions", "--no-frames"]
        store = record(policy, folder / f"success_{number}.zarr", tasks, episodes, max_steps, *light, *options)
        found.append({"policy": policy.name, "control": policy.control, "condition": name} | success(store))
    return found
