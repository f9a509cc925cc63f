"""What is wrong inside of an episode: everything is read back and compared with its attributes, digests and row sums.

Capture checks an episode with `content_problems` before it publishes it, and `verify.py` checks whole stores.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from vla_attention.schemas.effects import CHANGE, CUT
from vla_attention.schemas.episode_steps import EXECUTED, GRIPPER, POSE, POSES
from vla_attention.schemas.layout import prompt_at
from vla_attention.schemas.precision import FLOAT32_MANTISSA_BITS
from vla_attention.schemas.stores.content_rules import (
    absent_problems,
    camera_picture_problems,
    counter_problems,
    coverage_problems,
    cut_problems,
    effect_problems,
    gram_problems,
    picture_problems,
    piece_role_problems,
    prompt_problems,
    role_problems,
    row_problems,
    row_sum_problems,
    sites_with_text,
    step_problems,
    uniform_problems,
    unseen_problems,
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
            yield from _guarded(_array_problems(root, episode, name, record.sha256))
    for check in (_token_problems, _camera_problems, _counter_problems):
        yield from _guarded(check(root, episode))


def form_problems(root: RootAttributes, episode: StoredEpisode) -> Iterator[Problem]:
    """Which files and shapes of an episode are not as its run and its attributes say; reads none of the files."""
    attributes = episode.attributes
    shapes = _expected_shapes(root, attributes)
    numbers = {name: (len(given),) for name in NUMBERS if (given := getattr(attributes, name))}
    listed = {name: record.shape for name, record in attributes.arrays.items()} | numbers
    for name in sorted(set(shapes) - set(listed)):
        yield Problem(f"{name} is not in the episode")
    for name, shape in listed.items():
        yield from map(Problem, _shape_problems(name, shape, shapes.get(name, (attributes.num_replans,))))


def _expected_shapes(root: RootAttributes, attributes: EpisodeAttributes) -> dict[str, tuple[int, ...]]:
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


def _shape_problems(name: str, shape: tuple[int, ...], expected: tuple[int, ...]) -> Iterator[str]:
    """Whether an array has another shape than its first axes must have (`_expected_shapes`), as a sentence."""
    # Axes of `uniform` but the last have length 1 where nothing changes along them.
    if name.endswith("/uniform") and len(shape) == len(expected) and shape[-1:] == expected[-1:]:
        if all(given in (1, length) for given, length in zip(shape, expected, strict=True)):
            return
        yield f"{name} has the shape {shape}; expected {expected}, or 1 in place of a length but the last"
    elif shape[: len(expected)] != expected:
        yield f"{name} has the shape {shape}; expected {expected}"


def _guarded(check: Iterator[str]) -> Iterator[Problem]:
    """The problems that a check finds; an array or file that it cannot read is one more."""
    try:
        yield from map(Problem, check)
    except CorruptEpisode as error:
        yield Problem(str(error), error.file)


def _array_problems(root: RootAttributes, episode: StoredEpisode, name: str, sha256: str) -> Iterator[str]:
    """One pass over an array: its digest, and the rules for the numbers of rows, segments' masses and contributions."""
    shape = episode.shape_of(name)
    site_name, _, kind = name.rpartition("/")
    site = next((site for site in root.sites if site.name == site_name), None)
    recording = root.recording if site is None else root.recording.of_site(site)
    sums = _row_sums(episode, name, shape[:-1]) if kind in ("rows", "atoms") else None
    uniform = _uniform(episode, site_name) if kind == "rows" else None
    digest, problems = ArrayDigest(), list[str]()
    step = episode.reading_step(name)
    for first in range(0, shape[0], step):
        values = episode.read(name, slice(first, first + step))
        digest.update(values)
        if problems:
            continue  # the first block with a fault names its place
        if sums is not None:
            bits = recording.mantissa_bits if kind == "rows" else FLOAT32_MANTISSA_BITS
            problems += row_problems(name, values, sums[first : first + step], recording, bits, first)
            if kind == "rows" and site is not None and not problems:
                roles = episode.read(f"{site_name}/key_role", slice(first, first + step))
                problems += absent_problems(site, values, roles, recording, first)
                if uniform is not None:
                    of_block = uniform[first : first + step] if len(uniform) > 1 else uniform
                    problems += unseen_problems(name, values, of_block, recording, first)
        elif kind == "row_sum":
            problems += row_sum_problems(name, values, recording, first)
        elif kind == "uniform":
            problems += uniform_problems(name, values, first)
        elif name == CHANGE:
            problems += effect_problems(name, values, first)
        elif kind == CUT:
            problems += cut_problems(name, values, first)
        elif name in (POSES, GRIPPER, EXECUTED):
            problems += step_problems(name, values, first)
        elif kind == "contribution":
            problems += gram_problems(name, values, recording, first)
    if digest.hexdigest() != sha256:
        yield f"the values of {name} are not those that were written (digest differs)"
    yield from problems


def _row_sums(episode: StoredEpisode, name: str, shape: tuple[int, ...]) -> NDArray[np.float64] | None:
    """The exact sums that belong to rows or atoms; None when they are damaged (reported by their own check)."""
    try:
        sums: NDArray[np.float64] = episode.read(f"{name.rpartition('/')[0]}/row_sum").astype(np.float64)
    except CorruptEpisode:
        return None
    return sums if sums.shape == shape else None


def _uniform(episode: StoredEpisode, site: str) -> NDArray[np.float32] | None:
    """What uniform attention gives; None when it is damaged, or does not fit (reported by their own checks)."""
    try:
        uniform: NDArray[np.float32] = episode.read(f"{site}/uniform")
    except CorruptEpisode:
        return None
    rows = episode.shape_of(f"{site}/rows")
    fits = uniform.ndim == len(rows) and all(n in (1, m) for n, m in zip(uniform.shape, rows, strict=True))
    return uniform if fits else None


def _token_problems(root: RootAttributes, episode: StoredEpisode) -> Iterator[str]:
    prompts = episode.attributes.prompts
    for prompt in prompts:
        yield from prompt_problems(root.sites, prompt)
    index = episode.read("prompt_index")
    if not np.isin(index, np.arange(len(prompts))).all():
        yield "prompt_index names prompts that the attributes do not have"
        return
    only_site = len(sites_with_text(root.sites)) == 1
    for site in root.sites:
        roles = episode.read(f"{site.name}/key_role")
        yield from role_problems(site, roles)
        of_site = [prompt_at(root.sites, site, prompt) for prompt in prompts]
        for replan, number in enumerate(index[: len(roles)]):  # another length is named with the shapes
            yield from piece_role_problems(site, roles[replan], of_site[number], replan, only_site=only_site)


def _camera_problems(root: RootAttributes, episode: StoredEpisode) -> Iterator[str]:
    for name in episode.attributes.arrays:
        group, _, camera = name.partition("/")
        if group == "frames":
            about = episode.array(name).metadata
            yield from picture_problems(root.sites, camera, about.shape[1:], about.dtype)
        elif group == "camera_frames":
            about = episode.array(name).metadata
            yield from camera_picture_problems(root.sites, camera, about.shape[1:], about.dtype)
        elif group == "objects":
            yield from coverage_problems(root.sites, camera, episode.read(name), len(episode.attributes.objects))


def _counter_problems(_root: RootAttributes, episode: StoredEpisode) -> Iterator[str]:
    seeds = episode.read("noise_seed") if episode.has("noise_seed") else np.zeros(0, dtype=np.int64)
    yield from counter_problems(episode.read("env_step"), seeds)
    if episode.has("dataset_actions") and episode.has("dataset_action_count"):
        horizon = episode.shape_of("dataset_actions")[1]
        counts = episode.read("dataset_action_count")
        if not ((counts >= 1) & (counts <= horizon)).all():
            yield f"dataset_action_count is {counts.min()} to {counts.max()}; expected 1 to {horizon}"
