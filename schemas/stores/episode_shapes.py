"""Whether the arrays, numbers and names of an episode are those that its run has: looked at before any is read.

An analysis takes its axes from the run and its numbers from the episode. Each of them may be whole and sealed, and the
two not belong together.
"""

from __future__ import annotations

from collections.abc import Iterator

from vla_attention.schemas.effects import CHANGE, CUT
from vla_attention.schemas.episode_steps import EXECUTED, GRIPPER, HAND, POSE, POSES
from vla_attention.schemas.layout import Role
from vla_attention.schemas.stores.store_format import NUMBERS, EpisodeAttributes, RootAttributes

_ROLES = frozenset(role.label for role in Role)
#: Arrays of a site whose axes, but for the last, have length 1 where nothing changes along them.
_MAY_BE_ONE = ("uniform",)


def expected_shapes(root: RootAttributes, attributes: EpisodeAttributes) -> dict[str, tuple[int, ...]]:
    """First axes of every array that must be there; arrays that are not named here begin with the replans."""
    replans = attributes.num_replans
    shapes: dict[str, tuple[int, ...]] = {"denoise_time": (len(root.recording.denoise_steps),)}
    shapes |= dict.fromkeys(("env_step", "prompt_index"), (replans,))
    if not root.protocol.of_other_loop:
        shapes |= dict.fromkeys(("noise_seed", "state", "actions"), (replans,))
    if attributes.effects is not None and attributes.effects.replan:
        entries = len(attributes.effects.replan)
        actions = attributes.arrays.get("actions")
        # The caller's own loop may give one action of a chunk.
        horizon = root.policy.action_horizon if actions is None else actions.shape[1]
        shapes[CHANGE] = (entries, horizon, len(attributes.effects.units))
        shapes |= {f"{site.name}/{CUT}": (entries, site.num_keys) for site in root.sites}
    if attributes.steps is not None:
        moments = attributes.num_steps + 1
        shapes[POSES] = (moments, len(attributes.steps.bodies), POSE)
        shapes |= {GRIPPER: (moments,), EXECUTED: (attributes.num_steps,)}
    if "dataset_actions" in attributes.arrays:
        shapes["dataset_action_count"] = (replans,)
    for site in root.sites:
        recording = root.recording.of_site(site)
        cells = (
            replans,
            len(recording.layers),
            len(recording.denoise_steps),
            len(recording.heads),
            recording.num_queries,
        )
        shapes[f"{site.name}/rows"] = (*cells, site.num_keys)
        shapes[f"{site.name}/row_sum"] = cells
        shapes[f"{site.name}/atoms"] = (*cells, len(attributes.segments.get(site.name, ())))
        shapes[f"{site.name}/key_role"] = (replans, site.num_keys)
        shapes[f"{site.name}/uniform"] = (*cells, site.num_keys)
        if recording.contributions:
            parts = len(attributes.segments.get(site.name, ())) + 1
            shapes[f"{site.name}/contribution"] = (*cells[:3], parts, parts)
    return shapes


def shape_problems(name: str, shape: tuple[int, ...], expected: tuple[int, ...]) -> Iterator[str]:
    """Whether an array has another shape than its first axes must have (`expected_shapes`), as a sentence."""
    one_will_do = name.rpartition("/")[2] in _MAY_BE_ONE
    if one_will_do and len(shape) == len(expected) and shape[-1:] == expected[-1:]:
        if all(given in (1, length) for given, length in zip(shape, expected, strict=True)):
            return
        yield f"{name} has the shape {shape}; expected {expected}, or 1 in place of a length but the last"
    elif shape[: len(expected)] != expected:
        yield f"{name} has the shape {shape}; expected {expected}"


def effect_misfits(root: RootAttributes, attributes: EpisodeAttributes) -> Iterator[str]:
    """What of an episode's effects does not belong to its run, as sentences without a full stop."""
    effects, planned = attributes.effects, root.recording.effects
    if (effects is None) is not (planned is None):
        yield f"it has {'no ' if effects is None else ''}effects, other than its run"
    if effects is None or planned is None:
        return
    actions = attributes.arrays.get("actions")
    if actions is not None and actions.shape[-1] != len(effects.units):
        yield f"its effects have units of {len(effects.units)} dimensions of the action, which has {actions.shape[-1]}"
    for replan in dict.fromkeys(effects.replan):
        if replan >= attributes.num_replans or replan % planned.every:
            yield (
                f"its effects are of replan {replan}; expected every {planned.every} of its {attributes.num_replans} "
                "replans, from 0 on"
            )
            return


def step_misfits(attributes: EpisodeAttributes) -> Iterator[str]:
    """What of an episode's steps does not belong to its other attributes, as sentences without a full stop."""
    steps = attributes.steps
    if steps is None:
        return
    objects = {thing.name for thing in attributes.objects}
    for name in steps.bodies:
        if name != HAND and name not in objects:
            yield f"it has poses of '{name}', which is none of its objects"
    moments = [*steps.first_touch, *(goal.first_held for goal in steps.goals)]
    latest = max((moment for moment in moments if moment is not None), default=0)
    if latest > attributes.num_steps:
        yield f"something of it happened first at moment {latest}; it has {attributes.num_steps} steps"
    own = steps.goal_of(attributes.task_id)
    if own is None:
        yield f"its goals lack that of its own task {attributes.task_id}"
    elif attributes.success and own.first_held is None:
        yield "it is solved, and the goal of its task never held"
    # A goal that holds before the first action, and no more after it, is not reached.
    elif attributes.success is False and own.first_held:
        yield f"it is not solved, and the goal of its task held at moment {own.first_held}"


def misfits(root: RootAttributes, attributes: EpisodeAttributes) -> Iterator[str]:
    """What of an episode's attributes does not belong to its run, as sentences without a full stop. Reads no array."""
    replans = attributes.num_replans
    listed = {name: record.shape for name, record in attributes.arrays.items()}
    listed |= {name: (len(numbers),) for name in NUMBERS if (numbers := getattr(attributes, name))}
    shapes = expected_shapes(root, attributes)
    for site in root.sites:
        spans = {span.name for span in site.spans}
        for segment in attributes.segments.get(site.name, ()):
            if segment.span not in spans or segment.role not in _ROLES:
                yield f"its segment '{segment.role}' of span '{segment.span}' is none of site '{site.name}'"
        for camera in site.pictured:
            shapes[f"objects/{camera}"] = (replans, len(site.patch_keys(camera)), len(attributes.objects))
    for name, shape in listed.items():
        yield from shape_problems(name, shape, shapes.get(name, (replans,)))
    yield from effect_misfits(root, attributes)
    yield from step_misfits(attributes)
    if not all(0 <= number < len(attributes.prompts) for number in attributes.prompt_index):
        yield "prompt_index names prompts that the attributes do not have"
