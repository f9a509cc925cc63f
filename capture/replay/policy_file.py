"""`--policy FILE.py`: any torch policy, as a function of the user returns it."""

from __future__ import annotations

import importlib.util
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vla_attention.schemas.data_sets.lerobot_dataset import DataSetFrame
from vla_attention.schemas.errors import BadArgument, listing

if TYPE_CHECKING:
    from vla_attention.capture.torch_policies.policy_layout import PolicyLayout

#: What the file has to define.
FUNCTION = "load"


@dataclass(frozen=True)
class ReplayPolicy:
    """A policy for `vla-attention capture replay`: what is recorded, and how it is called on a frame.

    Attributes:
        policy: an `nn.Module`, or an object that has modules as attributes.
        layout: what its attention calls are (`va.layouts`, docs/my-policy.md).
        act: a frame of the data set -> the actions (horizon, action_dim), or None where they are not to be stored. It
            calls the policy once. A policy that answers from a queue has to be asked for a whole chunk, or reset
            before. torch's random numbers are seeded before every call.
        cameras: camera of the layout -> column of pictures; left out: the column of the same name. `none`: the policy
            gets no picture of it. `--camera` replaces it.
        state: columns of the state that is stored; empty: the usual ones, if the data set has them.
        actions: columns of the recorded actions; empty: the usual ones. `("none",)`: none.
        every: a call at frame 0, every, 2 · every ..., unless `--every` is given.
        tokenizer, checkpoint, untrained: as of `va.record`.
    """

    policy: Any
    layout: PolicyLayout
    act: Callable[[DataSetFrame], Any]
    cameras: Mapping[str, str] = field(default_factory=dict)
    state: tuple[str, ...] = ()
    actions: tuple[str, ...] = ()
    every: int = 1
    tokenizer: Any = None
    checkpoint: str = ""
    untrained: bool = False


def check_policy_file(name: str) -> Path:
    """Return the file's path; `BadArgument` if it is not there."""
    path = Path(name).expanduser()
    if not path.is_file():
        raise BadArgument(f"Cannot use --policy {name}: there is no such file.")
    return path


def load_policy_file(path: Path, device: str) -> ReplayPolicy:
    """Run the file, and call its function `load(device)`.

    The file's folder is where it imports from first, as with `python FILE.py`. Errors of the user's own code keep their
    traceback.

    Raises:
        BadArgument: the file has no such function, or it returns something else.
    """
    spec = importlib.util.spec_from_file_location(path.stem, path)
    if spec is None or spec.loader is None:
        raise BadArgument(f"Cannot use --policy {path}: it cannot be imported.")
    module = importlib.util.module_from_spec(spec)
    sys.path.insert(0, str(path.resolve().parent))
    sys.modules[path.stem] = module  # dataclasses of the file look their module up
    spec.loader.exec_module(module)
    load = getattr(module, FUNCTION, None)
    if not callable(load):
        defined = listing(name for name in vars(module) if not name.startswith("_"))
        raise BadArgument(
            f"Cannot use --policy {path}: it has no function '{FUNCTION}(device)' that returns a "
            f"va.datasets.ReplayPolicy; it defines {defined}."
        )
    policy = load(device)
    if not isinstance(policy, ReplayPolicy):
        raise BadArgument(
            f"Cannot use --policy {path}: its '{FUNCTION}' returned a {type(policy).__name__}, not a "
            "va.datasets.ReplayPolicy."
        )
    if policy.every < 1:
        raise BadArgument(f"Cannot use --policy {path}: its every is {policy.every}; expected at least 1.")
    return policy
