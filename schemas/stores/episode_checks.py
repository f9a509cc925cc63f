"""What is wrong inside of an episode: everything is read back and compared with its attributes, digests and row sums.

Capture checks an episode with `content_problems` before it publishes it, and `verify.py` checks whole stores.
"""

from __future__ import annotations

from collections.abc import Iterator, Set
from contextlib import suppress
from functools import cache
from itertools import islice
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vla_attention.schemas.episode_steps import EXECUTED, GRIPPER, POSE, POSES
from vla_attention.schemas.stores.content_rules import (
    Block,
    counter_problems,
    effect_shapes,
    map_shapes,
    piece_role_problems,
    prompt_problems,
    shape_problems,
    site_shapes,
    value_problems,
)
from vla_attention.schemas.stores.digest import ArrayDigest
from vla_attention.schemas.stores.episode_files import metadata_problems
from vla_attention.schemas.stores.reader import StoredEpisode
from vla_attention.schemas.stores.store_format import (
    NUMBERS,
    CorruptEpisode,
    EpisodeAttributes,
    Problem,
    RootAttributes,
)


def content_problems(root: RootAttributes, episode: StoredEpisode) -> Iterator[Problem]:
    """What is wrong inside an episode, wherever its folder is: metadata, shapes, values, row sums. Reads all of it.

    Raises:
        CorruptEpisode: the episode's attributes or its seal cannot be read.
    """
    attributes, wrong = episode.attributes, set[str]()
    # The files of arrays are compared with the seal when the arrays are read.
    for file in episode.files.records:
        if file.endswith("zarr.json"):
            yield from metadata_problems(episode, file)
    for problem in form_problems(root, episode):
        wrong.add(problem.text.partition(" ")[0])
        yield problem
    for name, record in attributes.arrays.items():
        if name not in wrong:
            yield from _guarded(_array_problems(root, episode, name, record.sha256, wrong))
    for check in (_token_problems, _counter_problems):
        yield from _guarded(check(root, episode))


def form_problems(root: RootAttributes, episode: StoredEpisode) -> Iterator[Problem]:
    """Which files and shapes of an episode are not as its run and its attributes say; reads none of the files."""
    attributes = episode.attributes
    shapes = _expected_shapes(root, attributes)
    numbers = {name: (len(given),) for name in NUMBERS if (given := getattr(attributes, name))}
    listed = {name: record.shape for name, record in attributes.arrays.items()} | numbers
    for name in sorted(set(shapes) - set(listed)):
        if not name.endswith("/uniform"):  # where the roles of the keys say it
            yield Problem(f"{name} is not in the episode")
    for site in root.sites:
        if {f"{site.name}/rows", f"{site.name}/atoms"} <= listed.keys():
            yield from _guarded(_type_problems(root, episode, site.name))
    for name, shape in listed.items():
        yield from map(Problem, shape_problems(name, shape, shapes.get(name, (attributes.num_replans,))))


def _expected_shapes(root: RootAttributes, attributes: EpisodeAttributes) -> dict[str, tuple[int, ...]]:
    """Shapes of every array that must be there (`shape_problems`); others begin with the replans."""
    replans = attributes.num_replans
    shapes: dict[str, tuple[int, ...]] = {"denoise_time": (len(root.recording.denoise_steps),)}
    shapes |= dict.fromkeys(("env_step", "prompt_index"), (replans,))
    if not root.protocol.of_other_loop:
        shapes |= dict.fromkeys(("noise_seed", "state", "actions"), (replans,))
    if attributes.effects is not None and attributes.effects.replan:
        actions = attributes.arrays.get("actions")
        # The caller's own loop may give one action of a chunk.
        horizon = root.policy.action_horizon if actions is None else actions.shape[1]
        shapes |= effect_shapes(root.sites, len(attributes.effects.replan), horizon, len(attributes.effects.units))
        if attributes.effects.map is not None:
            shapes |= map_shapes(attributes.effects.map, horizon, len(attributes.effects.units))
    if attributes.steps is not None:
        moments = attributes.num_steps + 1
        shapes[POSES] = (moments, len(attributes.steps.bodies), POSE)
        shapes |= {GRIPPER: (moments,), EXECUTED: (attributes.num_steps,)}
    if "dataset_actions" in attributes.arrays:
        shapes["dataset_action_count"] = (replans,)
    for site in root.sites:
        segments = len(attributes.segments.get(site.name, ()))
        shapes |= site_shapes(site, root.recording.of_site(site), replans, segments)
    return shapes


def _type_problems(root: RootAttributes, episode: StoredEpisode, site: str) -> Iterator[str]:
    episode.check_rows(root, site)
    yield from ()


def _guarded(check: Iterator[str]) -> Iterator[Problem]:
    """The problems that a check finds; an array or file that it cannot read is one more."""
    try:
        yield from map(Problem, check)
    except CorruptEpisode as error:
        yield Problem(str(error), error.file)


def _array_problems(
    root: RootAttributes, episode: StoredEpisode, name: str, sha256: str, wrong: Set[str]
) -> Iterator[str]:
    """One pass over an array: its digest, and the rule for its numbers. `wrong`: arrays whose shapes do not fit."""

    uniform = cache(episode.uniform)

    digest, problems = ArrayDigest(), list[str]()
    step = episode.reading_step(name)
    for first in range(0, episode.shape_of(name)[0], step):
        stored = episode.read_stored(name, first, min(first + step, episode.shape_of(name)[0]))
        digest.update(stored)
        values = episode.values_of(name, stored)

        def of_block(beside: str, first: int = first, count: int = len(stored)) -> NDArray[Any]:
            site, _, kind = beside.partition("/")
            source = f"{site}/atoms" if kind == "row_sum" else beside
            if source in wrong:
                raise CorruptEpisode(f"{beside} does not fit the episode")
            if kind == "uniform":  # it may be stored once for all replans
                return uniform(site)[first : first + count] if len(uniform(site)) > 1 else uniform(site)
            given = episode.read_stored(source, first, first + count)
            # Without a search for missing values: other masses of the replan may be no numbers.
            return np.asarray(given[..., -1]) if kind == "row_sum" else episode.values_of(source, given)

        if not problems:  # the first block with a fault names its place
            with suppress(CorruptEpisode):  # of an array beside it, which is reported where that one is read
                problems += value_problems(Block(root, len(episode.attributes.objects), name, values, of_block, first))
    if digest.hexdigest() != sha256:
        yield f"the values of {name} are not those that were written (digest differs)"
    yield from problems


def _token_problems(root: RootAttributes, episode: StoredEpisode) -> Iterator[str]:
    prompts = episode.attributes.prompts
    for prompt in prompts:
        yield from islice(prompt_problems(root.sites, prompt), 1)
    index = episode.read("prompt_index")
    if not np.isin(index, np.arange(len(prompts))).all():
        yield "prompt_index names prompts that the attributes do not have"
        return
    for site in root.sites:
        roles = episode.read(f"{site.name}/key_role")
        for replan, number in enumerate(index[: len(roles)]):  # another length is named with the shapes
            yield from piece_role_problems(root.sites, site, roles[replan], prompts[number], replan)


def _counter_problems(_root: RootAttributes, episode: StoredEpisode) -> Iterator[str]:
    seeds = episode.read("noise_seed") if episode.has("noise_seed") else np.zeros(0, dtype=np.int64)
    yield from counter_problems(episode.read("env_step"), seeds)
    if episode.has("dataset_actions") and episode.has("dataset_action_count"):
        horizon = episode.shape_of("dataset_actions")[1]
        counts = episode.read("dataset_action_count")
        if not ((counts >= 1) & (counts <= horizon)).all():
            yield f"dataset_action_count is {counts.min()} to {counts.max()}; expected 1 to {horizon}"
