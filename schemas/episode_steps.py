"""What happened at every environment step of an episode: where things were, what was touched, whose goal was reached.

Moment 0 is the end of the waiting steps, moment i the end of the step that executed action i. All of it is known where
a simulator of ours ran the episode; `docs/store.md` has the arrays.
"""

from __future__ import annotations

from vla_attention.schemas.errors import BadArgument, listing
from vla_attention.schemas.jsonable import Document
from vla_attention.schemas.limit_checks import check_at_most
from vla_attention.schemas.limits import BODIES, GOALS, REPLANS
from vla_attention.schemas.safe_text import check_free_text, check_name, check_text

#: Position (3,) in metres and orientation as a quaternion (w, x, y, z), in the world frame, of every body.
POSES = "steps/poses"
#: Positions of the finger joints in metres.
GRIPPER = "steps/gripper"
#: The actions that were executed, as given to the environment.
EXECUTED = "steps/actions"
#: Name of the first body: the gripper's site, between the fingers. The others are objects of the scene.
HAND = "hand"
#: Numbers of a pose.
POSE = 7


class TaskGoal(Document, frozen=True):
    """The goal of a task that shares the scene.

    `conditions`: what holds when it is reached, each as the simulator's words; a goal whose conditions are among
    another's is contained in it. `first_held`: the moment at which it first held; None: never.
    """

    task_id: int
    task_name: str
    instruction: str
    conditions: tuple[str, ...]
    first_held: int | None

    def __post_init__(self) -> None:
        """Check the texts, and the moment."""
        check_name("task", self.task_name)
        check_free_text("instruction", self.instruction)
        for condition in self.conditions:
            check_text("goal's condition", condition)
        _check_moment(f"The goal of task {self.task_id}", self.first_held)


class EpisodeSteps(Document, frozen=True):
    """What the arrays `steps/...` of an episode are of, and what they were looked at for.

    `bodies`: whose poses are stored: `HAND`, then objects of the episode. `first_touch`: the moment at whose end the
    gripper first touched the body; None: at none, and for the hand. `goals`: of all tasks that share the scene, the
    episode's own among them.
    """

    bodies: tuple[str, ...]
    first_touch: tuple[int | None, ...]
    goals: tuple[TaskGoal, ...]

    def __post_init__(self) -> None:
        """Check that names are different, and that there is a moment or None for each body."""
        check_at_most("The number of bodies whose poses are stored", len(self.bodies), BODIES, least=1)
        check_at_most("The number of goals", len(self.goals), GOALS)
        for name in self.bodies:
            check_name("body", name)
        if self.bodies[0] != HAND or len(set(self.bodies)) != len(self.bodies):
            raise BadArgument(
                f"The bodies of an episode are {listing(self.bodies)}; expected '{HAND}', then others, each once."
            )
        if len(self.first_touch) != len(self.bodies) or self.first_touch[0] is not None:
            raise BadArgument(
                f"There are {len(self.first_touch)} first touches of {len(self.bodies)} bodies; expected one of each, "
                f"and none of the {HAND}."
            )
        for name, moment in zip(self.bodies, self.first_touch, strict=True):
            _check_moment(f"The first touch of '{name}'", moment)
        tasks = [goal.task_id for goal in self.goals]
        if len(set(tasks)) != len(tasks):
            raise BadArgument(f"There are goals of the tasks {listing(tasks)}; expected each task once.")

    def goal_of(self, task_id: int) -> TaskGoal | None:
        """The goal of a task; None where it shares no scene with the episode."""
        return next((goal for goal in self.goals if goal.task_id == task_id), None)

    @property
    def touched(self) -> tuple[str, ...]:
        """The bodies that the gripper touched, the first one first; those touched at one moment in their order."""
        known = [(moment, place) for place, moment in enumerate(self.first_touch) if moment is not None]
        return tuple(self.bodies[place] for _, place in sorted(known))


def _check_moment(what: str, moment: int | None) -> None:
    if moment is not None:
        check_at_most(what, moment, REPLANS)
