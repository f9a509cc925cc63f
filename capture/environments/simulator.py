"""What LIBERO's and robosuite's environments share: drawing on request, a kept context, steps, segmentation, closing.

Which moment a picture shows: robosuite's camera observables sample by their own timer. It advances by one physics
substep (2 ms) at every update, and also at every forced update. LIBERO forces two updates (reset, then the stored
state), so a picture shows the scene at the beginning of the 24th of a step's 25 substeps. robosuite's own tasks force
one update, and a picture shows the 25th. Here the timers run unchanged; only the drawing inside the sensor is skipped
without a request.
"""

from __future__ import annotations

import atexit
import contextlib
import copy
import functools
import hashlib
import random
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vla_attention.capture.environments.base import (
    BACKGROUND,
    NO_DEPARTURES,
    ROBOT,
    Departures,
    EnvironmentSettings,
    Moment,
    Observation,
    StepResult,
    Task,
    check_initial_state_index,
)
from vla_attention.capture.environments.episode_protocol import ACTION_SIZE, CAMERAS, CONTROL_FREQUENCY_HZ
from vla_attention.capture.environments.robosuite_installation import import_robosuite, readable_device_choice
from vla_attention.schemas.episode_steps import HAND, TaskGoal
from vla_attention.schemas.errors import BadArgument, unknown_name
from vla_attention.schemas.groupings.vocabulary import SceneObject


@contextlib.contextmanager
def seeded(seed: int) -> Iterator[None]:
    """Seed the global random generators, which robosuite and LIBERO use; restore the caller's state afterwards."""
    if not 0 <= seed < 2**32:
        raise BadArgument(f"The environment seed is {seed}; it must be between 0 and {2**32 - 1}.")
    numpy_state, python_state = np.random.get_state(), random.getstate()  # noqa: NPY002 (robosuite uses it)
    np.random.seed(seed)  # noqa: NPY002
    random.seed(seed)
    try:
        yield
    finally:
        np.random.set_state(numpy_state)  # noqa: NPY002
        random.setstate(python_state)


class CameraGate:
    """Decides whether camera sensors draw. While `open` is False, a sensor returns a blank picture at once.

    `before_drawing` is called before each real drawing, at the physics moment that the picture shows.
    `num_drawn` counts the drawings.
    """

    def __init__(self, image_size: int, before_drawing: Callable[[], None]) -> None:
        self.open = False
        self.num_drawn = 0
        self._blank = np.zeros((image_size, image_size, 3), dtype=np.uint8)
        self._before_drawing = before_drawing

    def attach(self, simulator: Any) -> None:
        """Make the camera sensors of `simulator` (not yet initialised) obey this gate.

        This replaces a method of the instance instead of deriving a class: robosuite registers every derived class
        under its name, so a derived class would replace the original in the whole process.
        """
        create = simulator._create_camera_sensors

        def create_gated(*arguments: Any, **options: Any) -> tuple[list[Any], list[str]]:
            sensors, names = create(*arguments, **options)
            return [self._gated(sensor) for sensor in sensors], names

        simulator._create_camera_sensors = create_gated

    def _gated(self, sensor: Callable[[Any], NDArray[np.uint8]]) -> Callable[[Any], NDArray[np.uint8]]:
        @functools.wraps(sensor)  # robosuite keeps the sensor's modality as an attribute of the function
        def gated(observation_cache: Any) -> NDArray[np.uint8]:
            if not self.open:
                return self._blank
            self._before_drawing()
            self.num_drawn += 1
            return sensor(observation_cache)

        return gated


def goal_of(task: Task, conditions: Iterable[str], things: Iterable[str] = ()) -> TaskGoal:
    """Return the goal of a task, before any step; things: the objects that it names as its subject."""
    return TaskGoal(task.task_id, task.name, task.instruction, tuple(conditions), None, tuple(things))


class SimulatedEnvironment:
    """Base class of the environments; implements `Environment` except for the beginning of an episode.

    A subclass builds the simulator, chooses the random numbers of a reset, sets the initial state after it, and lists
    the scene objects.

    suite_tasks: the suite's, of which some share the scene; the task alone if there are none.
    """

    def __init__(self, task: Task, settings: EnvironmentSettings, suite_tasks: Sequence[Task] = ()) -> None:
        import_robosuite()
        self.task = task
        self._suite_tasks = tuple(suite_tasks) or (task,)
        self._image_size = settings.protocol.image_size
        self._gate = CameraGate(self._image_size, before_drawing=self._keep_moment)
        self._digest: str | None = None
        self._moment: Any = None  # copy of the simulation data at the moment of the last pictures
        self._closed = False
        with readable_device_choice(), seeded(0):
            self._simulator = self._build(self._simulator_options())
        # Freeing an EGL context after EGL's own end prints errors at interpreter exit. atexit calls the functions in
        # reverse order, and `_build` made robosuite register EGL's end, so `close` runs before it.
        atexit.register(self.close)
        named, roots = self._describe_objects()
        self.objects = (*named, SceneObject(ROBOT, "robot", False), SceneObject(BACKGROUND, "background", False))
        robot = self._simulator.robots[0]
        of_robot = (robot.robot_model.root_body, robot.robot_model.mount.root_body, robot.gripper.root_body)
        self._roots = {**roots, ROBOT: of_robot}
        self.bodies = (
            HAND,
            *(thing.name for thing in self.objects if thing.name in self._roots and thing.name != ROBOT),
        )
        self.goals = tuple(self._scene_goals())

    def _simulator_options(self) -> dict[str, Any]:
        """Options of the published LIBERO evaluations: a Panda arm, pose deltas of its gripper, two cameras."""
        from robosuite.controllers import load_controller_config

        return {
            "robots": ["Panda"],
            "controller_configs": load_controller_config(default_controller="OSC_POSE"),
            "use_camera_obs": True,
            "has_renderer": False,
            "has_offscreen_renderer": True,
            "control_freq": CONTROL_FREQUENCY_HZ,
            "ignore_done": True,  # the rollout counts the steps
            "camera_names": list(CAMERAS),
            "camera_heights": self._image_size,
            "camera_widths": self._image_size,
        }

    def _construct(self, environment_class: Any, *arguments: Any, **options: Any) -> Any:
        """Create an instance of a robosuite environment class whose cameras obey the gate."""
        simulator = environment_class.__new__(environment_class)
        self._gate.attach(simulator)
        self._kept_context = KeptContext(simulator)
        simulator.__init__(*arguments, **options)
        return simulator

    def _build(self, options: dict[str, Any]) -> Any:
        """Create the simulator with `_construct`."""
        raise NotImplementedError

    def _reset_seed(self, initial_state_index: int, seed: int) -> int:
        """Return the seed of the global generators at the beginning of `_reset_simulator`."""
        raise NotImplementedError

    def _reset_simulator(self, initial_state_index: int, seed: int) -> None:
        """Make the simulator's own reset; called with seeded generators, which `_reset_seed` chooses."""
        self._reset_once()

    def _set_initial_state(self, initial_state_index: int) -> None:
        """Set the state with which the episode begins, where the simulator's own reset has not done so."""

    def _describe_objects(self) -> tuple[Iterable[SceneObject], Mapping[str, Sequence[str]]]:
        """Return the scene objects but robot and background, and the root bodies of each by its name.

        It owns them and all bodies below them.
        """
        raise NotImplementedError

    def _scene_goals(self) -> Sequence[TaskGoal]:
        """Return the goals of all tasks of the suite that share the scene; this task's is among them."""
        return [goal_of(self.task, ("solved",))]

    def _held(self) -> Sequence[bool]:
        """Return for each of `goals` whether it holds now. It must change nothing."""
        return [bool(self._simulator._check_success())]

    def reset(self, initial_state_index: int, seed: int) -> None:
        """Begin an episode; see `Environment.reset`. The subclass determines the use of `seed`."""
        check_initial_state_index(self.task, initial_state_index)
        with seeded(self._reset_seed(initial_state_index, seed)):
            self._reset_simulator(initial_state_index, seed)
            self._set_initial_state(initial_state_index)
        from vla_attention.capture.environments.segmentation import owners_of_bodies

        model = self._simulator.sim.model
        state = np.asarray(self._simulator.sim.get_state().flatten(), dtype=np.float64)
        self._digest = hashlib.sha256(state.tobytes()).hexdigest()
        self._moment = None
        index_of = {scene_object.name: index for index, scene_object in enumerate(self.objects)}
        roots = {model.body_name2id(body): index_of[name] for name, bodies in self._roots.items() for body in bodies}
        self._background = index_of[BACKGROUND]
        self._owners = owners_of_bodies(model.body_parentid, roots, self._background)
        self._root_of = [model.body_name2id(self._roots[name][0]) for name in self.bodies[1:]]
        # Of every geom the number of its body in `bodies`, -1 for none, and whether it is the gripper's.
        place = {index_of[name]: number for number, name in enumerate(self.bodies) if name != HAND}
        gripper = model.body_name2id(self._simulator.robots[0].gripper.root_body)
        hands = owners_of_bodies(model.body_parentid, {gripper: 1}, 0)
        self._body_of_geom = np.array([place.get(int(self._owners[body]), -1) for body in model.geom_bodyid])
        self._is_gripper_geom = hands[model.geom_bodyid] == 1

    def missing_resets(self, initial_state_index: int, seed: int) -> int:
        """Return 0: no episode depends on another; see `Environment.missing_resets`."""
        return 0

    def _reset_once(self, can_draw: bool = True) -> None:
        """Reset the simulator. Without `can_draw`, it gets no drawing context, which may take half of the time."""
        from robosuite.utils.errors import RandomizationError

        self._simulator.has_offscreen_renderer = can_draw
        while True:
            # A reset frees the old drawing context, and OpenGL frees names in the current context. If the current
            # context were another environment's, the pictures of that environment would break.
            self._make_context_current()
            try:
                self._simulator.reset()
                return
            except RandomizationError:  # the objects did not fit; like the protocol, try again with further draws
                continue

    @property
    def initial_state_digest(self) -> str:
        """SHA-256 of the initial state of the episode; see `Environment.initial_state_digest`."""
        return self._require_episode()

    def _require_episode(self) -> str:
        if self._digest is None or self._closed:
            raise RuntimeError("There is no episode: call reset() first, and nothing after close().")
        return self._digest

    def step(self, action: NDArray[np.floating], observe: bool) -> StepResult:
        """Advance by one control step; see `Environment.step`."""
        self._require_episode()
        action = np.asarray(action, dtype=np.float64)
        if action.shape != (ACTION_SIZE,) or not np.isfinite(action).all():
            # On numbers that are not finite, MuJoCo resets the simulation without an error.
            raise BadArgument(f"An action is {ACTION_SIZE} finite numbers; got shape {action.shape}: {action}.")
        self._gate.open, self._gate.num_drawn = observe, 0
        if observe:
            self._moment = None
        try:
            values = self._simulator.step(action)[0]
        finally:
            self._gate.open = False
        success = bool(self._simulator._check_success())
        if not observe:
            return StepResult(success, None)
        if self._gate.num_drawn != len(CAMERAS):
            raise RuntimeError(f"One step drew {self._gate.num_drawn} pictures for {len(CAMERAS)} cameras.")
        return StepResult(
            success,
            Observation(
                images={camera: values[f"{camera}_image"] for camera in CAMERAS},
                eef_pos=np.array(values["robot0_eef_pos"], dtype=np.float64),
                eef_quat=np.array(values["robot0_eef_quat"], dtype=np.float64),
                gripper_qpos=np.array(values["robot0_gripper_qpos"], dtype=np.float64),
            ),
        )

    def moment(self) -> Moment:
        """Return where things are now; see `TellsMoments`."""
        self._require_episode()
        data, robot = self._simulator.sim.data, self._simulator.robots[0]
        hand = np.concatenate([data.site_xpos[robot.eef_site_id], self._site_orientation(robot.eef_site_id)])
        roots = np.concatenate([data.body_xpos[self._root_of], data.body_xquat[self._root_of]], axis=1)
        touched = np.zeros(len(self.bodies), dtype=bool)
        touched[self._touched_now()] = True
        return Moment(
            poses=np.concatenate([hand[None], roots]).astype(np.float32),
            gripper=np.array([data.qpos[joint] for joint in robot._ref_gripper_joint_pos_indexes], dtype=np.float32),
            touched=touched,
            held=np.array(self._held(), dtype=bool),
        )

    def departures(self) -> Departures:
        """Return none: it is not known how the scene should begin; see `TellsMoments`."""
        return NO_DEPARTURES

    def _site_orientation(self, site: int) -> NDArray[np.float64]:
        """A site's quaternion (w, x, y, z). `eef_quat`, which policies get, is that of the body above the gripper."""
        import mujoco

        quaternion = np.zeros(4)
        mujoco.mju_mat2Quat(quaternion, self._simulator.sim.data.site_xmat[site].reshape(9))
        return quaternion

    def _touched_now(self) -> NDArray[np.intp]:
        """Numbers in `bodies` of what the gripper touches."""
        data = self._simulator.sim.data._data
        pairs = np.array(data.contact.geom[: data.ncon]).reshape(-1, 2)
        both = np.concatenate([pairs, pairs[:, ::-1]])
        of_gripper = both[self._is_gripper_geom[both[:, 0]], 1]
        places = self._body_of_geom[of_gripper]
        return np.unique(places[places >= 0])

    def _keep_moment(self) -> None:
        """Before the first picture of a step, copy the state that it shows; the step ends with another state."""
        self._make_context_current()
        if self._moment is None:
            self._moment = copy.copy(self._simulator.sim.data._data)

    def _make_context_current(self) -> None:
        context = getattr(self._simulator.sim, "_render_context_offscreen", None)
        if context is not None:
            context.gl_ctx.make_current()

    def segmentation(self, camera: str) -> NDArray[np.int32]:
        """Return the object of every pixel of the last picture; see `Environment.segmentation`."""
        from vla_attention.capture.environments.segmentation import draw_object_indices

        if camera not in CAMERAS:
            raise unknown_name("camera", camera, CAMERAS)
        self._require_episode()
        if self._moment is None:
            raise RuntimeError("No picture of this episode exists yet; step with observe=True first.")
        self._make_context_current()
        simulation = self._simulator.sim
        return draw_object_indices(
            simulation._render_context_offscreen,
            self._moment,
            simulation.model.camera_name2id(camera),
            self._image_size,
            self._owners,
            self._background,
        )

    def close(self) -> None:
        """Free the simulator and its drawing context. A second call does nothing."""
        if self._closed:
            return
        self._closed = True
        atexit.unregister(self.close)
        self._make_context_current()
        self._simulator.close()
        self._kept_context.free()
        self._moment = None


#: What may differ between resets: places of bodies in their parents, and colours of helper sites, which robosuite hides
#: after a reset. Both are read for every picture.
_READ_FOR_EVERY_PICTURE = ("body_pos", "body_quat", "site_rgba")
#: The number of things that a scene may hold, as in robosuite.
_MOST_DRAWN = 1000


class KeptContext:
    """Keeps the drawing context of `simulator` (not yet initialised) when robosuite frees the rest of a scene.

    Every reset of robosuite reads the scene anew and makes a drawing context for it, which uploads all meshes and
    textures: half of a reset's time. Between the resets of a task nothing differs but where cabinets and the like
    stand, which is read from the model for every picture. So the context goes on with the new model if everything else
    is the same; the pictures are the same to the bit.
    """

    def __init__(self, simulator: Any) -> None:
        # Methods of the instance, not a derived class: see `CameraGate.attach`.
        self._simulator = simulator
        self._kept: Any = None
        self._destroy, self._initialize = simulator._destroy_sim, simulator._initialize_sim
        simulator._destroy_sim, simulator._initialize_sim = self._destroy_scene, self._initialize_scene

    def free(self) -> None:
        """Free the context if it is kept; afterwards nothing is."""
        if self._kept is not None:
            self._kept.gl_ctx.make_current()  # OpenGL frees names in the current context
            self._kept = None

    def _destroy_scene(self) -> None:
        context = getattr(self._simulator.sim, "_render_context_offscreen", None)
        if context is not None:
            self._kept, context.sim, context.data = context, None, None
            self._simulator.sim._render_context_offscreen = None
        self._destroy()

    def _initialize_scene(self, *given: Any, **options: Any) -> None:
        self._initialize(*given, **options)
        context, simulation = self._kept, self._simulator.sim
        if context is None or not self._simulator.has_offscreen_renderer:
            return
        if not draw_alike(context.model._model, simulation.model._model):
            self.free()  # robosuite makes another one
            return
        self._kept = None
        simulation.forward()  # as where a context is made
        context.sim, context.model, context.data = simulation, simulation.model, simulation.data
        import mujoco

        context.scn = mujoco.MjvScene(simulation.model._model, maxgeom=_MOST_DRAWN)
        context.cam, context.vopt, context.pert = mujoco.MjvCamera(), mujoco.MjvOption(), mujoco.MjvPerturb()
        simulation.add_render_context(context)


def draw_alike(one: Any, other: Any) -> bool:
    """Tell whether one drawing context serves both models: all is the same but what is read for every picture."""
    for name in dir(one):
        if name.startswith("_") or name in _READ_FOR_EVERY_PICTURE or callable(mine := getattr(one, name)):
            continue
        its = getattr(other, name)
        # The normals of a mesh without area are NaN, as of some of LIBERO's: as bytes they are the same.
        if not (mine.tobytes() == its.tobytes() if isinstance(mine, np.ndarray) else mine == its):
            return False
    return True
