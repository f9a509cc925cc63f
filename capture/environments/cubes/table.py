"""The simulated table with cubes: a robosuite environment. Imports robosuite; load it when a simulator is needed."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from robosuite.environments.manipulation.single_arm_env import SingleArmEnv
from robosuite.models.arenas import TableArena
from robosuite.models.objects import BoxObject
from robosuite.models.tasks import ManipulationTask

from vla_attention.capture.environments.cubes.scene import HALF_SIZE, TABLE_HEIGHT, Scene, find_target
from vla_attention.capture.environments.cubes.tasks import COLOURS, CubeTask

_TABLE_SIZE = (0.8, 0.8, 0.05)
_FRICTION = (1.0, 5e-3, 1e-4)
_RGB = {"red": (0.85, 0.1, 0.1), "green": (0.1, 0.65, 0.15), "blue": (0.1, 0.2, 0.85), "yellow": (0.9, 0.8, 0.1)}

#: Stands for the gripper among the indices of the cubes.
_GRIPPER = -1
#: Height in metres over its rest at which a cube counts as lifted, and the way after which it counts as pushed.
LIFTED, PUSHED = 0.04, 0.05


class CubeTable(SingleArmEnv):  # type: ignore[misc]  # robosuite has no types
    """Cubes of different colours on a table.

    `scene` and `task` can be set before a reset. After every control step the environment knows which cube the gripper
    touched first in the episode.
    """

    def __init__(self, task: CubeTask, **options: Any) -> None:
        self.task = task
        self.scene: Scene | None = None
        self._touched_first: list[int] = []
        self.target = 0
        self.destination: int | None = None
        super().__init__(mount_types="default", initialization_noise="default", hard_reset=False, **options)

    def _load_model(self) -> None:
        super()._load_model()
        robot_model = self.robots[0].robot_model
        robot_model.set_base_xpos(robot_model.base_xpos_offset["table"](_TABLE_SIZE[0]))
        arena = TableArena(
            table_full_size=_TABLE_SIZE, table_friction=_FRICTION, table_offset=np.array((0.0, 0.0, TABLE_HEIGHT))
        )
        arena.set_origin([0, 0, 0])
        size = [HALF_SIZE] * 3
        self._cubes = [
            BoxObject(name=f"{colour}_cube", size_min=size, size_max=size, rgba=[*_RGB[colour], 1.0])
            for colour in COLOURS[: self.task.num_cubes]
        ]
        self.model = ManipulationTask(
            mujoco_arena=arena, mujoco_robots=[robot.robot_model for robot in self.robots], mujoco_objects=self._cubes
        )

    def _initialize_sim(self, *arguments: Any, **options: Any) -> None:
        super()._initialize_sim(*arguments, **options)
        # Mirror images in the floor and the table are half of the cost of a picture.
        self.sim.model.mat_reflectance[:] = 0.0

    def _setup_references(self) -> None:
        super()._setup_references()
        model = self.sim.model
        self._bodies = [model.body_name2id(cube.root_body) for cube in self._cubes]
        of_cubes = {name: index for index, cube in enumerate(self._cubes) for name in cube.contact_geoms}
        of_gripper = dict.fromkeys(self.robots[0].gripper.contact_geoms, _GRIPPER)
        self._owners = {model.geom_name2id(name): owner for name, owner in (of_cubes | of_gripper).items()}

    def _reset_internal(self) -> None:
        super()._reset_internal()
        # The model is not loaded again at a reset, and robosuite's gripper would go on with the action it had.
        gripper = self.robots[0].gripper
        gripper.current_action = np.zeros(gripper.dof)
        scene = self.scene
        if scene is None:  # robosuite resets once while it is constructed
            count = self.task.num_cubes
            scene = Scene(np.stack([np.zeros(count), np.linspace(-0.15, 0.15, count)], axis=1), np.zeros(count))
        for cube, (x, y), yaw in zip(self._cubes, scene.positions, scene.yaws, strict=True):
            pose = [x, y, TABLE_HEIGHT + HALF_SIZE + 0.001, np.cos(yaw / 2), 0.0, 0.0, np.sin(yaw / 2)]
            self.sim.data.set_joint_qpos(cube.joints[0], np.array(pose))
        self._beginning = np.column_stack([scene.positions, np.full(len(scene.positions), TABLE_HEIGHT + HALF_SIZE)])
        # Which cube is meant depends on the places at the beginning of the episode.
        places, task = self._beginning, self.task
        self._touched_first = []
        self.target = find_target(task.target, places)
        self.destination = None if task.destination is None else find_target(task.destination, places)

    def _post_action(self, action: NDArray[np.float64]) -> Any:
        result = super()._post_action(action)
        self._touched_first = self._touched_first or self.touched_cubes()
        return result

    @property
    def first_touched(self) -> int | None:
        """The cube that the gripper touched first; of two that were touched in one control step, the wrong one."""
        return self._first_but(self.target)

    def _first_but(self, target: int) -> int | None:
        return min(self._touched_first, key=lambda cube: cube == target, default=None)

    def _contacts(self) -> set[frozenset[int | None]]:
        """What touches what now: pairs of cubes, `_GRIPPER`, and None for everything else."""
        contacts = self.sim.data.contact[: self.sim.data.ncon]
        return {frozenset((self._owners.get(one.geom1), self._owners.get(one.geom2))) for one in contacts}

    def touched_cubes(self) -> list[int]:
        """Return the cubes that the gripper touches now."""
        contacts = self._contacts()
        return [cube for cube in range(len(self._cubes)) if frozenset((cube, _GRIPPER)) in contacts]

    def cube_positions(self) -> NDArray[np.float64]:
        """Return the cubes' centres, (cube, 3) in metres, world frame."""
        return np.array(self.sim.data.body_xpos[self._bodies])

    def reward(self, action: NDArray[np.float64] | None = None) -> float:
        """Return 1 if the task is solved, else 0."""
        return float(self._check_success())

    def _check_success(self) -> bool:
        """Return whether the task is solved now."""
        return self.solves(self.task)

    def solves(self, task: CubeTask) -> bool:
        """Return whether a task with these cubes is solved now, as if it had been asked for from the beginning."""
        target = find_target(task.target, self._beginning)
        position = self.cube_positions()[target]
        moved = position - self._beginning[target]
        verb = task.verb
        if verb == "touch":
            return self._first_but(target) == target
        if verb == "lift":
            return bool(moved[2] >= LIFTED)
        if verb == "push_left":
            return bool(moved[1] >= PUSHED)
        if verb == "push_right":
            return bool(moved[1] <= -PUSHED)
        assert task.destination is not None
        destination = find_target(task.destination, self._beginning)
        released = target not in self.touched_cubes()
        above = position[2] - self.cube_positions()[destination][2] > HALF_SIZE
        return bool(released and above and frozenset((target, destination)) in self._contacts())
