"""What the caller says of an episode and of a replan, checked."""

from __future__ import annotations

import hashlib
import operator
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields
from inspect import Parameter, signature
from typing import Any, SupportsIndex

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vla_attention.capture.environments.coverage import camera_coverage
from vla_attention.capture.torch_policies.policy_layout import PictureFit, PolicyLayout
from vla_attention.schemas.errors import BadArgument, listing, unknown_name
from vla_attention.schemas.fitted_pictures import fitted_box, fitted_part
from vla_attention.schemas.groupings.vocabulary import SceneObject
from vla_attention.schemas.layout import WHOLE, Part, Prompt, camera_grids, picture_size
from vla_attention.schemas.safe_text import check_text


@dataclass(frozen=True)
class EpisodeFacts:
    """What is known of an episode before it begins; the arguments of `RecordedRun.episode`."""

    task_id: int
    episode_index: int
    instruction: str
    seed: int | None = None
    task_name: str | None = None
    objects: tuple[SceneObject, ...] = ()
    task_family: str = ""
    siblings: Sequence[str] = ()
    initial_state: str | ArrayLike = ""

    def __post_init__(self) -> None:
        """Check the numbers and the texts."""
        for name in ("task_id", "episode_index"):
            number = whole_number(f"{name} of an episode", getattr(self, name))
            if number < 0:
                raise BadArgument(f"The {name} of an episode is {number}; expected 0 or more.")
            object.__setattr__(self, name, number)
        if not isinstance(self.instruction, str):
            raise BadArgument(f"The instruction of an episode is {self.instruction!r}; expected a text.")
        if not isinstance(self.task_family, str):
            raise BadArgument(f"The task_family of an episode is {self.task_family!r}; expected a text, or none.")
        check_text("task family", self.task_family)
        if isinstance(self.siblings, str) or not all(isinstance(text, str) for text in self.siblings):
            raise BadArgument(f"The siblings of an episode are {self.siblings!r}; expected a list of instructions.")
        if not isinstance(self.initial_state, str) and np.asarray(self.initial_state).dtype.kind not in "biuf":
            raise BadArgument(f"The initial state of an episode is {self.initial_state!r}; expected numbers or a text.")

    @property
    def initial_state_digest(self) -> str:
        """The sha256 of the initial state, of its bytes as a simulator's is; empty where it is not known."""
        state = self.initial_state
        content = state.encode() if isinstance(state, str) else np.ascontiguousarray(state).tobytes()
        return hashlib.sha256(content).hexdigest() if content else ""


@dataclass(frozen=True)
class RepeatedCall:
    """What a policy call is repeated with, to measure an effect.

    instruction: that of the call, or with another word. frames: camera -> picture as given to `replan`, or a grey one.
    """

    instruction: str
    frames: Mapping[str, Any]


@dataclass(frozen=True)
class Repeat:
    """A callable that makes the policy call again; takes_call: it is given a `RepeatedCall`. given: the call's own."""

    call: Callable[..., Any]
    takes_call: bool
    given: RepeatedCall


@dataclass(frozen=True)
class ReplanInputs:
    """What the caller gives to `replan(...)`, checked and in the store's form; `Episode.replan` describes each.

    coverage: also what masks gave.
    """

    env_step: int
    frames: Mapping[str, NDArray[np.uint8]] = field(default_factory=dict)
    state: NDArray[np.float64] | None = None
    instruction: str = ""
    prompt: Prompt | Sequence[str | None] | None = None
    roles: Mapping[str, NDArray[np.uint8]] = field(default_factory=dict)
    noise_seed: int | None = None
    masks: Mapping[str, NDArray[np.integer]] = field(default_factory=dict)
    coverage: Mapping[str, NDArray[np.float32]] = field(default_factory=dict)
    dataset_actions: NDArray[np.float64] | None = None
    repeat: Repeat | None = None
    shown: Mapping[str, Part] = field(default_factory=dict)


def whole_number(what: str, given: Any) -> int:
    """Return an int of what a caller's loop counts with (numpy's and torch's numbers too), or raise `BadArgument`."""
    try:
        return operator.index(given)
    except TypeError:
        raise BadArgument(f"The {what} is {given!r}; expected a whole number.") from None


def _numbers(what: str, given: Any, axes: int, expected: str) -> NDArray[np.float64] | None:
    """Return numbers as float64, or raise `BadArgument`; None for None. A first axis of length 1 may be left out."""
    if given is None:
        return None
    values = given.detach().float().cpu().numpy() if hasattr(given, "detach") else given
    try:
        # A copy: the policy may write its next actions to the same array.
        values = np.array(values, dtype=np.float64)
    except (TypeError, ValueError):
        raise BadArgument(f"The {what} of a replan: no array of numbers (given: {type(given).__name__}).") from None
    numbers: NDArray[np.float64] = values[0] if values.ndim == axes + 1 and len(values) == 1 else values
    numbers = numbers[None] if what == "actions" and numbers.ndim == 1 else numbers
    if numbers.ndim != axes or (axes > 1 and not numbers.size):
        raise BadArgument(f"The {what} of a replan: an array of the shape {values.shape}; expected {expected}.")
    return numbers


#: Parameters that take any number of arguments.
_REST = (Parameter.VAR_POSITIONAL, Parameter.VAR_KEYWORD)
_NAMES = tuple(part.name for part in fields(ReplanInputs) if part.name not in ("env_step", "shown"))


def read_inputs(
    layout: PolicyLayout, facts: EpisodeFacts, env_step: SupportsIndex, given: Mapping[str, Any]
) -> ReplanInputs:
    """Return what a caller gave for one replan, checked and in the store's form.

    Raises:
        BadArgument: an argument or a camera does not exist, or a value has another shape or type.
    """
    for name in given:
        if name not in _NAMES:
            raise unknown_name("argument of replan()", name, _NAMES)
    values = {name: value for name, value in given.items() if value is not None}
    sites = [site.keys for site in layout.sites]
    fits = {camera.name: camera.fit for camera in layout.cameras}
    cameras, with_patches = layout.camera_names, {camera for site in sites for camera in site.pictured}
    for what in ("frames", "masks", "coverage", "roles"):
        if not isinstance(values.get(what, {}), Mapping):
            raise BadArgument(
                f"{what} of a replan is of type {type(values[what]).__name__}; expected a dictionary by "
                f"{'site' if what == 'roles' else 'camera'}."
            )
    for site in values.get("roles", ()):
        layout.site(site)
    if not isinstance(values.get("instruction", ""), str):
        raise BadArgument(f"The instruction of a replan is {values['instruction']!r}; expected a text.")
    for what in ("frames", "masks", "coverage"):
        for camera in values.get(what, ()):
            if camera not in cameras:
                raise unknown_name(f"camera of {what}", camera, cameras)
            if what != "frames" and camera not in with_patches:
                raise BadArgument(
                    f"The camera '{camera}' has no patches in the layout, which objects could cover: leave it out of "
                    f"{what}, or give a span of it a grid (va.PatchGrid)."
                )
    pictures, shown = values.get("frames", {}), dict[str, Part]()
    frames = {}
    for camera in cameras:
        if camera in pictures:
            size = picture_size(sites, camera) if camera in with_patches else None  # latents have any
            frames[camera], part = model_picture(pictures[camera], camera, size, fits.get(camera, "stretch"))
            shown |= {camera: part} if part != WHOLE else {}
    coverage = {camera: np.asarray(array, dtype=np.float32) for camera, array in values.get("coverage", {}).items()}
    for camera, mask in values.get("masks", {}).items():
        coverage[camera] = camera_coverage(np.asarray(mask), len(facts.objects), camera_grids(sites, camera))
    seed = values.get("noise_seed", facts.seed)
    if seed is not None and not -(2**63) <= (seed := whole_number("seed of a replan's noise", seed)) < 2**63:
        raise BadArgument(f"The seed of a replan's noise is {seed}; expected a number of 64 bits.")
    return ReplanInputs(
        env_step=whole_number("env_step of a replan", env_step),
        frames=frames,
        state=_numbers("state", values.get("state"), 1, "(state_dim,)"),
        instruction=values.get("instruction", facts.instruction),
        prompt=values.get("prompt"),
        roles=values.get("roles", {}),
        noise_seed=seed,
        coverage={camera: coverage[camera] for camera in cameras if camera in coverage},
        dataset_actions=_numbers("dataset_actions", values.get("dataset_actions"), 2, "(step, action_dim)"),
        repeat=_repeat(values, facts),
        shown=shown,
    )


def _repeat(values: Mapping[str, Any], facts: EpisodeFacts) -> Repeat | None:
    call = values.get("repeat")
    if call is None:
        return None
    try:
        parameters = list(signature(call).parameters.values())
    except (TypeError, ValueError):
        raise BadArgument(f"The repeat of a replan is {call!r}; expected a callable, as lambda call: ....") from None
    needed = [one for one in parameters if one.default is one.empty and one.kind not in _REST]
    if len(needed) > 1 or any(one.kind is one.KEYWORD_ONLY for one in needed):
        raise BadArgument(
            f"The repeat of a replan needs the arguments {listing(one.name for one in needed)}; expected one, the call "
            "with its instruction and frames, or none."
        )
    given = RepeatedCall(values.get("instruction", facts.instruction), dict(values.get("frames", {})))
    return Repeat(call, bool(needed), given)


def read_actions(given: Any) -> NDArray[np.float64] | None:
    """Return actions as (horizon, action_dim) float64; None where the caller gave none."""
    return _numbers("actions", given, 2, "(horizon, action_dim) or (action_dim,)")


def model_picture(
    picture: Any, camera: str, size: tuple[int, int] | None, fit: PictureFit
) -> tuple[NDArray[np.uint8], Part]:
    """Return a camera's picture as (height, width, 3) uint8 of the model's input size, and the part that shows it.

    picture: (height, width, 3) uint8, or (3, height, width) with numbers from 0 to 1, as an array or a tensor; a batch
    axis of length 1 may come first. size: None leaves the picture's own. fit: how other sizes become the model's, see
    `CameraPicture`.

    Raises:
        BadArgument: another shape or type.
    """
    levels = _levels(picture, camera)
    if size is None or levels.shape[:2] == size:
        return levels, WHOLE
    height, width = size
    if fit == "stretch":
        return _resized(levels, height, width), WHOLE
    given, towards = (levels.shape[0], levels.shape[1]), 1.0 if fit == "pad_left_top" else 0.5
    top, left, rows, columns = fitted_box(given, size, towards)
    padding = ((top, height - rows - top), (left, width - columns - left), (0, 0))
    return np.pad(_resized(levels, rows, columns), padding), fitted_part(given, size, towards)


def _levels(picture: Any, camera: str) -> NDArray[np.uint8]:
    """The picture as (row, column, channel) uint8."""
    if hasattr(picture, "detach"):
        picture = picture.detach().cpu()
        picture = (picture.float() if picture.is_floating_point() else picture).numpy()
    values = np.asarray(picture)
    values = values[0] if values.ndim == 4 and len(values) == 1 else values
    shape = values.shape
    if not values.size:
        raise BadArgument(f"The picture of camera '{camera}' is empty: its shape is {shape}.")
    if values.ndim == 3 and shape[0] == 3 != shape[-1]:
        values = values.transpose(1, 2, 0)
    if values.ndim != 3 or values.shape[-1] != 3 or (values.dtype != np.uint8 and values.dtype.kind != "f"):
        raise BadArgument(
            f"The picture of camera '{camera}' has the shape {shape} and type {values.dtype}; expected (height, "
            "width, 3) uint8, or (3, height, width) with numbers from 0 to 1."
        )
    if values.dtype != np.uint8:
        if not (values.min() >= 0 and values.max() <= 1):
            raise BadArgument(
                f"The picture of camera '{camera}' has numbers from {values.min():.3g} to {values.max():.3g}; give it "
                "before normalising, as uint8 or from 0 to 1."
            )
        values = np.rint(values * 255).astype(np.uint8)
    return np.ascontiguousarray(values)


def _resized(picture: NDArray[np.uint8], height: int, width: int) -> NDArray[np.uint8]:
    """The picture in another size, bilinear with smoothing."""
    import torch

    with torch.no_grad():
        values = torch.from_numpy(picture).permute(2, 0, 1)[None].float()
        small = torch.nn.functional.interpolate(
            values, (height, width), mode="bilinear", align_corners=False, antialias=True
        )
        result: NDArray[np.uint8] = small[0].permute(1, 2, 0).round().clamp(0, 255).to(torch.uint8).numpy()
    return np.ascontiguousarray(result)
