"""The interventions of a rerun: read from the arguments, and checked on every stored policy call before any is made."""

from __future__ import annotations

import argparse
from collections.abc import Iterable

import numpy as np
from msgspec.structs import replace

from vla_attention.capture.interventions.arguments import read_interventions
from vla_attention.capture.interventions.changed_inputs import CallContext, object_patches
from vla_attention.capture.interventions.condition_name import condition_name
from vla_attention.capture.interventions.prompts import changed_instruction, check_synonyms
from vla_attention.capture.interventions.run_changes import check_stored_replans
from vla_attention.capture.rerun.base_store import instructions_of
from vla_attention.schemas.errors import BadArgument, listing, unknown_name
from vla_attention.schemas.groupings.resolve import EmptyGroup
from vla_attention.schemas.interventions import ImageChange, Interventions, PromptChange
from vla_attention.schemas.stores.reader import Store


def rerun_interventions(arguments: argparse.Namespace) -> Interventions:
    """Return the interventions of the options, named by `--name` or by what they are."""
    interventions = read_interventions(arguments)
    return replace(interventions, name=arguments.name or condition_name(interventions))


def told(base: Store, change: PromptChange | None) -> list[str]:
    """Return what the policy is told in the stored calls, and in those with another prompt."""
    known = instructions_of(base)
    texts = []
    for attributes in (episode.attributes for episode in base.episodes):
        place = {"task_id": attributes.task_id, "episode_index": attributes.episode_index}
        for text in (prompt.instruction_text for prompt in attributes.prompts):
            texts.append(text)
            if change is not None:
                texts.append(changed_instruction(text, change, **place, instructions=known))
    return list(dict.fromkeys(texts))


def check_on_store(interventions: Interventions, base: Store, *, allow_empty: bool) -> list[str]:
    """Check interventions on every stored call; returns lines that say where nothing changes.

    Raises:
        SelectorError, UnknownName: a name exists nowhere in the store.
        EmptyGroup: a group has no key in some calls, or an object is out of view, unless `allow_empty`.
        BadArgument: there is no instruction of a task, or none with a word that has a synonym.
    """
    prompt = interventions.prompt
    instructions = instructions_of(base)
    if prompt is not None and prompt.kind == "synonyms":
        check_synonyms(prompt, [episode.attributes.instruction for episode in base.episodes])
    if prompt is not None and prompt.kind == "task" and prompt.task_id not in instructions:
        raise BadArgument(
            f"Cannot use the prompt of task {prompt.task_id}: {base.path} has no episode of it, and thus not its "
            f"instruction; it has tasks {listing(sorted(instructions))}."
        )
    lines = []
    if prompt is None:  # else the words of the other prompt are checked at each call
        empty = check_stored_replans(interventions, base, allow_empty=allow_empty)
        if empty:
            lines.append(f"In {empty} replans a group has no key; nothing is changed for it there.")
    for change in interventions.images:
        lines += _check_object(change, base, allow_empty) if change.object else []
    return lines


def _check_object(change: ImageChange, base: Store, allow_empty: bool) -> Iterable[str]:
    """Check that an object to be masked or filled is in view at every call."""
    names = dict.fromkeys(thing.name for episode in base.episodes for thing in episode.attributes.objects)
    if change.object not in names:
        raise unknown_name("object", change.object, names)
    cameras = [camera.name for camera in base.attributes.policy.cameras]
    if change.camera not in cameras:
        raise unknown_name("camera", change.camera, cameras)
    first, empty, total = "", 0, 0
    for episode in base.episodes:
        attributes, name = episode.attributes, f"objects/{change.camera}"
        coverage = episode.read(name) if name in attributes.arrays else None
        for replan in range(attributes.num_replans):
            given = {} if coverage is None else {change.camera: coverage[replan]}
            context = CallContext(
                attributes.task_id, attributes.episode_index, replan, objects=attributes.objects, coverage=given
            )
            total += 1
            if not np.any(object_patches(change, context, known=True)):
                first, empty = first or f"replan {replan} of {episode.name}", empty + 1
    if empty and not allow_empty:
        raise EmptyGroup(
            f"The object '{change.object}' is out of view of camera '{change.camera}' in {empty} of {total} replans, "
            f"the first is {first}; add --allow-empty to leave such pictures as they are, or choose episodes by "
            "--task-id."
        )
    if empty:
        yield f"In {empty} of {total} replans '{change.object}' is out of view of '{change.camera}'; they stay."
