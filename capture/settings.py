"""What a user asks a capture to do. Imports nothing heavy: command lines are read before torch is."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from vla_attention.capture.environments.base import EnvironmentSettings, Suite

if TYPE_CHECKING:
    from vla_attention.capture.store.store_writer import WriteMode


@dataclass(frozen=True)
class RecordingSettings:
    """What a user asks to be recorded; None and empty mean the default."""

    layers: tuple[int, ...] | None = None
    denoise_steps: tuple[str, ...] = ("first", "last")
    heads: tuple[int, ...] | None = None
    queries: str = "mean"
    mantissa_bits: int = 10
    frames: bool = True
    contributions: bool = True


@dataclass(frozen=True)
class RunSettings:
    """What a user asks to be run."""

    suite: Suite
    task_id: int | None
    num_episodes: int
    seed: int
    #: None: what the policy's own evaluation does
    replan_steps: int | None
    max_steps: int
    store: Path
    mode: WriteMode
    environment: EnvironmentSettings
    recording: RecordingSettings
    #: tasks that other processes of the same array job run; they belong to what is expected of the store
    array_task_ids: tuple[int, ...] = ()
