"""What both kinds of suite share: loading robosuite quietly, drawing on demand, stepping, segmenting, closing.

When the protocol's picture is taken: robosuite's camera observables sample on a timer of their own that advances by one
physics substep (2 ms) at every update and also at every forced update. LIBERO forces two (reset, then the stored
state), so a picture shows the scene as the 24th of a step's 25 substeps begins; robosuite's own tasks force one, and
there it is the 25th. The timers here run as ever; only the drawing inside the sensor is skipped when nobody looks.
"""

from __future__ import annotations

import atexit
import contextlib
import functools
import hashlib
import importlib.util
import os
import random
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vla_attention.capture.environments.base import (
    BACKGROUND,
    ROBOT,
    EnvironmentSettings,
    Observation,
    SceneObject,
    StepResult,
    Task,
)
from vla_attention.capture.environments.suites import Suite, check_initial_state_index
from vla_attention.schemas.errors import BadArgument, MissingDependency, unknown_name

CAMERAS = ("agentview", "robot0_eye_in_hand")
ACTION_SIZE = 7


def import_robosuite() -> None:
    """Import robosuite without its log file and advice; raise `MissingDependency` where it is not installed."""
    if "robosuite" in sys.modules:
        return
    spec = importlib.util.find_spec("robosuite")
    if spec is None or not spec.submodule_search_locations:
        raise MissingDependency("robosuite is not installed, and simulations need it; run 'make setup'.")
    if sys.platform == "linux":
        os.environ.setdefault("MUJOCO_GL", "egl")  # before MuJoCo's first import, which decides by it
    # robosuite reads its settings while it is imported, and by default it opens a log file of a fixed name in the
    # common temporary folder: on a shared node that belongs to whoever came first, and the import fails for everyone
    # else. Its settings module imports nothing, so it can be loaded before the package and changed.
    location = os.path.join(next(iter(spec.submodule_search_locations)), "macros.py")
    macros_spec = importlib.util.spec_from_file_location("robosuite.macros", location)
    assert macros_spec is not None
    assert macros_spec.loader is not None
    macros: Any = importlib.util.module_from_spec(macros_spec)
    macros_spec.loader.exec_module(macros)
    macros.FILE_LOGGING_LEVEL = None
    macros.CONSOLE_LOGGING_LEVEL = "ERROR"
    sys.modules["robosuite.macros"] = macros
    try:
        with readable_device_choice():
            import robosuite
    except ImportError as error:
        sys.modules.pop("robosuite.macros", None)
        raise MissingDependency(f"robosuite could not be loaded ({error}); run 'make setup'.") from error
    robosuite.macros = macros


@contextlib.contextmanager
def readable_device_choice() -> Iterator[None]:
    """Hide a CUDA_VISIBLE_DEVICES that robosuite's EGL code cannot read, while it reads it.

    It takes the variable for a list of EGL device numbers and fails on what clusters put there (GPU or MIG identifiers,
    an empty value), and on a MUJOCO_EGL_DEVICE_ID that is no part of it.
    """
    value = os.environ.get("CUDA_VISIBLE_DEVICES")
    unreadable = value is not None and not all(part.strip().isdigit() for part in value.split(","))
    if value is None or not (unreadable or "MUJOCO_EGL_DEVICE_ID" in os.environ):
        yield
        return
    del os.environ["CUDA_VISIBLE_DEVICES"]
    try:
        yield
    finally:
        os.environ["CUDA_VISIBLE_DEVICES"] = value


@contextlib.contextmanager
def seeded(seed: int) -> Iterator[None]:
    """Seed the global generators that robosuite and LIBERO draw from, and give the caller's back afterwards."""
    if not 0 <= seed < 2**32:
        raise BadArgument(f"The environment seed is {seed}; it must be between 0 and {2**32 - 1}.")
    numpy_state, python_state = np.random.get_state(), random.getstate()  # noqa: NPY002 (theirs is the global one)
    np.random.seed(seed)  # noqa: NPY002
    random.seed(seed)
    try:
        yield
    finally:
        np.random.set_state(numpy_state)  # noqa: NPY002
        random.setstate(python_state)


class CameraGate:
    """Stands between the camera observables and the drawing: closed, a sensor returns a blank picture at once.

    `before_drawing` is called when a picture is really drawn, at the very physics moment that it shows.
    """

    def __init__(self, image_size: int, before_drawing: Callable[[], None]) -> None:
        self.open = False
        self.num_drawn = 0
        self._blank = np.zeros((image_size, image_size, 3), dtype=np.uint8)
        self._before_drawing = before_drawing

    def attach(self, simulator: Any) -> None:
        """Make `simulator` (not yet initialised) build its camera sensors behind this gate.

        The instance's method is replaced rather than the class derived from: robosuite registers every derived class
        under its name, and ours would take the place of the original for everyone in the process.
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


class SimulatedEnvironment:
    """Base of the robosuite environments; implements `Environment` (see there) apart from how an episode starts.

    A subclass says how the simulator is built, which seed a reset uses, how the initial state is set afterwards, and
    which scene objects there are.
    """

    def __init__(self, suite: Suite, task: Task, settings: EnvironmentSettings) -> None:
        import_robosuite()
        self.task = task
        self.cameras: tuple[str, ...] = CAMERAS
        self.max_steps = suite.max_steps
        self.wait_steps = 10
        self.wait_action = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, -1.0])
        self._image_size = settings.image_size
        self._gate = CameraGate(settings.image_size, before_drawing=self._keep_moment)
        self._digest: str | None = None
        self._moment: Any = None  # copy of the simulation data at the moment that the last pictures show
        self._moment_is_kept = False
        self._closed = False
        with readable_device_choice(), seeded(0):
            self._simulator = self._build(self._simulator_options(settings))
        # An EGL context that outlives EGL complains at interpreter exit. atexit runs backwards, and robosuite has
        # registered EGL's end while building, so this comes first.
        atexit.register(self.close)
        self.objects, self._roots = self._describe_objects()

    @staticmethod
    def _simulator_options(settings: EnvironmentSettings) -> dict[str, Any]:
        """Options of the published LIBERO evaluation: Panda, end-effector pose deltas at 20 Hz, two cameras."""
        from robosuite.controllers import load_controller_config

        return {
            "robots": ["Panda"],
            "controller_configs": load_controller_config(default_controller="OSC_POSE"),
            "use_camera_obs": True,
            "has_renderer": False,
            "has_offscreen_renderer": True,
            "control_freq": 20,
            "ignore_done": True,  # the rollout counts its steps itself
            "camera_names": list(CAMERAS),
            "camera_heights": settings.image_size,
            "camera_widths": settings.image_size,
        }

    def _construct(self, environment_class: Any, *arguments: Any, **options: Any) -> Any:
        """Create an instance of a robosuite environment class with its cameras behind the gate."""
        simulator = environment_class.__new__(environment_class)
        self._gate.attach(simulator)
        simulator.__init__(*arguments, **options)
        return simulator

    def _build(self, options: dict[str, Any]) -> Any:
        raise NotImplementedError

    def _reset_seed(self, initial_state_index: int, seed: int) -> int:
        raise NotImplementedError

    def _set_initial_state(self, initial_state_index: int) -> None:
        raise NotImplementedError

    def _describe_objects(self) -> tuple[tuple[SceneObject, ...], Mapping[str, Sequence[str]]]:
        """Return the scene objects, and for each of their names the bodies it consists of, with all below them."""
        raise NotImplementedError

    def reset(self, initial_state_index: int, seed: int) -> None:
        """Begin an episode; see `Environment.reset`. The subclass says what `seed` is used for."""
        from robosuite.utils.errors import RandomizationError

        check_initial_state_index(self.task, initial_state_index)
        with seeded(self._reset_seed(initial_state_index, seed)):
            while True:
                # A reset frees the old drawing context, and OpenGL frees names in whichever context is current: if
                # that were another environment's, the pictures of that one would break.
                self._make_context_current()
                try:
                    self._simulator.reset()
                    break
                except RandomizationError:  # objects did not fit; the protocol draws again, further down the stream
                    continue
            self._set_initial_state(initial_state_index)
        import mujoco

        from vla_attention.capture.environments.segmentation import owners_of_bodies

        model = self._simulator.sim.model
        self._digest = hashlib.sha256(self._flat_state().tobytes()).hexdigest()
        self._moment = mujoco.MjData(model._model)
        self._moment_is_kept = False
        index_of = {scene_object.name: index for index, scene_object in enumerate(self.objects)}
        roots = {model.body_name2id(body): index_of[name] for name, bodies in self._roots.items() for body in bodies}
        self._background = index_of[BACKGROUND]
        self._owners = owners_of_bodies(model.body_parentid, roots, self._background)

    def _flat_state(self) -> NDArray[np.float64]:
        return np.asarray(self._simulator.sim.get_state().flatten(), dtype=np.float64)

    @property
    def initial_state_digest(self) -> str:
        """SHA-256 of the state the episode began with; see `Environment.initial_state_digest`."""
        return self._require_episode()

    def _require_episode(self) -> str:
        if self._digest is None or self._closed:
            raise RuntimeError("There is no episode: reset() comes first, and nothing comes after close().")
        return self._digest

    def step(self, action: NDArray[np.floating], observe: bool) -> StepResult:
        """Advance by one control step; see `Environment.step`."""
        self._require_episode()
        action = np.asarray(action, dtype=np.float64)
        if action.shape != (ACTION_SIZE,) or not np.isfinite(action).all():
            # MuJoCo would answer numbers that are not finite by quietly starting over.
            raise BadArgument(f"An action is {ACTION_SIZE} finite numbers; got shape {action.shape}: {action}.")
        self._gate.open, self._gate.num_drawn = observe, 0
        if observe:
            self._moment_is_kept = False
        try:
            values = self._simulator.step(action)[0]
        finally:
            self._gate.open = False
        success = bool(self._simulator._check_success())
        if not observe:
            return StepResult(success, None)
        if self._gate.num_drawn != len(self.cameras):
            raise RuntimeError(f"One step drew {self._gate.num_drawn} pictures for {len(self.cameras)} cameras.")
        return StepResult(
            success,
            Observation(
                images={camera: values[f"{camera}_image"] for camera in self.cameras},
                eef_pos=np.array(values["robot0_eef_pos"], dtype=np.float64),
                eef_quat=np.array(values["robot0_eef_quat"], dtype=np.float64),
                gripper_qpos=np.array(values["robot0_gripper_qpos"], dtype=np.float64),
            ),
        )

    def _keep_moment(self) -> None:
        """Before the first picture of a step: keep the state it shows, which is not the one the step ends with."""
        self._make_context_current()
        if not self._moment_is_kept:
            import mujoco

            simulation = self._simulator.sim
            mujoco.mj_copyData(self._moment, simulation.model._model, simulation.data._data)
            self._moment_is_kept = True

    def _make_context_current(self) -> None:
        context = getattr(self._simulator.sim, "_render_context_offscreen", None)
        if context is not None:
            context.gl_ctx.make_current()

    def segmentation(self, camera: str) -> NDArray[np.int32]:
        """Return the object of every pixel of the last picture; see `Environment.segmentation`."""
        from vla_attention.capture.environments.segmentation import draw_object_indices

        if camera not in self.cameras:
            raise unknown_name("camera", camera, self.cameras)
        self._require_episode()
        if not self._moment_is_kept:
            raise RuntimeError("No picture was taken in this episode yet; step with observe=True first.")
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
        """Free the simulator and its drawing context. Closing twice is fine."""
        if self._closed:
            return
        self._closed = True
        atexit.unregister(self.close)
        self._make_context_current()
        self._simulator.close()
        self._moment = None

    def _robot_bodies(self) -> list[str]:
        robot = self._simulator.robots[0]
        return [robot.robot_model.root_body, robot.robot_model.mount.root_body, robot.gripper.root_body]

    def _with_robot_and_background(self, named: Sequence[SceneObject]) -> tuple[SceneObject, ...]:
        robot, background = SceneObject(ROBOT, "robot", False), SceneObject(BACKGROUND, "background", False)
        return (*named, robot, background)
