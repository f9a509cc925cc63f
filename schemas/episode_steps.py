"""What happened at every environment step of an episode: where things were, what was touched, whose goal was reached.

Moment 0 is the end of the waiting steps, moment i the end of the step that executed action i. All of it is known where
a simulator of ours ran the episode; `docs/store.md` has the arrays.
"""

from __future__ import annotations

from vla_attention.schemas.jsonable import Document, Number

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
    another's is contained in it. `first_held`: the moment at which it first held; None: never. `things`: the objects
    of the scene that the task names as its subject; none where that is not known.
    """

    task_id: int
    task_name: str
    instruction: str
    conditions: tuple[str, ...]
    first_held: int | None
    things: tuple[str, ...] = ()


class Displaced(Document, frozen=True):
    """An object of LIBERO that stood elsewhere at moment 0 than under `libero_physics.PUBLISHED_MUJOCO`; metres."""

    name: str
    distance: Number


class EpisodeSteps(Document, frozen=True):
    """What the arrays `steps/...` of an episode are of, and what they were looked at for.

    `bodies`: whose poses are stored: `HAND`, then objects of the episode. `first_touch`: the moment at whose end the
    gripper first touched the body; None: at none, and for the hand. `goals`: of all tasks that share the scene, the
    episode's own among them. `mujoco`: the version that simulated it. `lost_relations`: what LIBERO's task file says of
    the beginning, is so under `libero_physics.PUBLISHED_MUJOCO`, and was not so at moment 0 (`bowl_1 on ramekin_1`).
    `displaced`: the objects that stood elsewhere.
    """

    bodies: tuple[str, ...]
    first_touch: tuple[int | None, ...]
    goals: tuple[TaskGoal, ...]
    mujoco: str = ""
    lost_relations: tuple[str, ...] = ()
    displaced: tuple[Displaced, ...] = ()

    def goal_of(self, task_id: int) -> TaskGoal | None:
        """The goal of a task; None where it shares no scene with the episode."""
        return next((goal for goal in self.goals if goal.task_id == task_id), None)

    @property
    def touched(self) -> tuple[str, ...]:
        """The bodies that the gripper touched, the first one first; those touched at one moment in their order."""
        known = [(moment, place) for place, moment in enumerate(self.first_touch) if moment is not None]
        return tuple(self.bodies[place] for _, place in sorted(known))
