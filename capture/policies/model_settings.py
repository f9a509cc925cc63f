"""The settings of a policy's model that every family has."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

from vla_attention.schemas.options import option

#: The two untrained policies that come with the program: a small one, and a smaller one for tests.
UNTRAINED = "untrained"
UNTRAINED_TINY = "untrained-tiny"
UNTRAINED_POLICIES = (UNTRAINED, UNTRAINED_TINY)


def checkpoint_option(text: str, default: str = UNTRAINED, **more: Any) -> Any:
    """`--checkpoint`, the first field of a family's settings; text: what it takes besides the untrained policies."""
    untrained = f"'{UNTRAINED}' and '{UNTRAINED_TINY}' have random weights and come along"
    return option(f"{text}; {untrained} (default: %(default)s)", default, group="model", metavar="PATH", **more)


@dataclass(frozen=True)
class ModelSettings:
    """Which model is loaded, in which precision and where. A family's own class says what it takes as a checkpoint."""

    checkpoint: str = checkpoint_option("checkpoint folder")
    config_name: str | None = option("name of the configuration", None)
    dtype: Literal["float32", "bfloat16"] | None = option("precision", None)
    device: str = option("auto (default: a GPU if there is one), cpu, cuda, cuda:1 ...", "auto", metavar="DEVICE")
    threads: int | None = option(
        "processor threads of the policy (default: OMP_NUM_THREADS, else the cores that this process may use)", None
    )
