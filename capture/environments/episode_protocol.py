"""The published LIBERO evaluations: the numbers that are the same in all of them, and those in which they differ.

Sources: `examples/libero/main.py` of openpi, `envs/libero.py` and `scripts/lerobot_eval.py` of LeRobot. A policy family
with an evaluation of its own has its `EvaluationProtocol` in its folder. `docs/my-checkpoint.md` has them in a table.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

#: Steps of an episode before the first policy call. The simulator drops objects onto the table, and they must come to
#: rest.
WAIT_STEPS = 10
#: The action of a waiting step: no motion, gripper open.
WAIT_ACTION = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, -1.0)
#: Numbers of an action: six pose deltas of the gripper and its opening.
ACTION_SIZE = 7
#: Control steps per simulated second.
CONTROL_FREQUENCY_HZ = 20
#: Actions that openpi's client executes of each chunk.
OPENPI_REPLAN_STEPS = 5
#: The two cameras, by their names in robosuite: one beside the table, one on the hand.
CAMERAS = ("agentview", "robot0_eye_in_hand")

#: How the simulator's random numbers are seeded. "once per task": with the run's seed, after the environment was made;
#: each reset continues where the one before it stopped. "per episode": before each reset, with the run's seed plus the
#: number of the episode. "always 0": before each reset, with 0, whatever the run's seed is.
Seeding = Literal["once per task", "per episode", "always 0"]


@dataclass(frozen=True)
class EvaluationProtocol:
    """How a published evaluation runs its episodes, where this differs between evaluations.

    image_size: height and width of a camera picture in pixels, before the policy's own preprocessing.
    earlier_resets: resets of a task's environment between its construction and the first episode.
    default_seed: the default of the run's seed.
    replan_steps: actions executed per policy call; None: as many as the checkpoint states.
    max_steps: policy steps of the suites for which they differ from `Suite.max_steps`.
    """

    name: str
    image_size: int
    seeding: Seeding
    default_seed: int
    earlier_resets: int = 0
    replan_steps: int | None = None
    max_steps: Mapping[str, int] = field(default_factory=dict)


OPENPI = EvaluationProtocol(
    "openpi", image_size=256, seeding="once per task", default_seed=7, replan_steps=OPENPI_REPLAN_STEPS
)
LEROBOT = EvaluationProtocol(
    "lerobot",
    image_size=360,
    seeding="per episode",
    default_seed=1000,
    earlier_resets=1,
    max_steps={"libero_spatial": 280},
)
