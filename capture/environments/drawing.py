"""Whether this machine draws for a suite: one picture in a process of its own, and what mends it where it does not.

Drivers that do not fit end the whole process, and a process that has loaded them for one setting cannot try another.
"""

from __future__ import annotations

import ctypes
import json
import os
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from pathlib import Path

from vla_attention.capture.environments.base import Suite
from vla_attention.capture.environments.libero_assets import find_assets
from vla_attention.capture.environments.libero_installation import load_libero
from vla_attention.capture.environments.robosuite_installation import (
    DEFAULT_GL,
    CannotDraw,
    first_reason,
    import_robosuite,
    readable_device_choice,
)
from vla_attention.capture.environments.suites import check_installed
from vla_attention.schemas.errors import MissingDependency, UserError

#: Seconds after which drawing counts as hanging; the first picture of a GPU's driver can take half a minute.
_TIMEOUT_S = 120
#: Variables that steer drawing begin like these.
_STEERING = ("MUJOCO_", "PYOPENGL_", "EGL_", "__EGL_", "LIBGL_", "GALLIUM_", "MESA_")
#: robosuite takes its numbers for those of EGL's devices.
_GPUS = "CUDA_VISIBLE_DEVICES"
#: Libraries that MuJoCo and OpenCV, which robosuite imports, load from the system, with Debian's packages.
_LIBRARIES = {
    "libEGL.so.1": "libegl1",
    "libOpenGL.so.0": "libopengl0",
    "libGL.so.1": "libgl1",
    "libgthread-2.0.so.0": "libglib2.0-0",
}
_SCENE = """<mujoco><worldbody><light pos="0 0 3"/><geom type="box" size=".2 .2 .2" rgba="1 0 0 1"/>
<camera pos="0 -1 1" xyaxes="1 0 0 0 1 1"/></worldbody></mujoco>"""
_PROGRAM = """import sys; sys.path[:] = sys.argv[3:]
from vla_attention.capture.environments.drawing import main; main(*sys.argv[1:3])"""


#: Draws in an environment; returns the renderer, or raises `CannotDraw` with the reason.
Draw = Callable[[Mapping[str, str]], str]


def check_simulator(suite: Suite, libero_assets: Path | None) -> None:
    """Raise what the first episode of a suite would raise: see `check_installed` and `check_drawing`."""
    check_installed(suite, libero_assets)
    check_drawing(suite, libero_assets)


def check_drawing(suite: Suite, libero_assets: Path | None) -> str:
    """Load a suite's simulator in a process of its own, and draw one picture as it does; returns the renderer.

    Raises:
        CannotDraw: the first reason, and the variable or the package that mends it.
        MissingDependency: something that robosuite or LIBERO imports is not there.
    """

    return draw_or_say_what_mends(partial(_draw_in_a_process, suite, libero_assets), os.environ)


def draw_or_say_what_mends(draw: Draw, environment: Mapping[str, str]) -> str:
    """Draw in an environment; where that fails, raise what fails with the first change of it that draws."""
    try:
        return draw(environment)
    except CannotDraw as error:
        given = [name for name in sorted(environment) if name.startswith(_STEERING)]
        values = {"MUJOCO_GL": DEFAULT_GL} | {name: environment[name] for name in given}
        if _GPUS in environment:
            values[_GPUS] = environment[_GPUS]
        tried = f"{error} Tried with {', '.join(f'{name}={value}' for name, value in values.items())}."
        for to_do, changed in _changes(environment, given):
            try:
                renderer = draw(changed)
            except CannotDraw:
                continue
            raise CannotDraw(f"{tried} Do `{to_do}`: {renderer} then draws here.") from None
        raise CannotDraw(f"{tried} {_what_to_install()}") from None


def _changes(environment: Mapping[str, str], given: list[str]) -> Iterator[tuple[str, dict[str, str]]]:
    """Changes of an environment that may mend drawing, each with the command that makes it."""

    def without(names: list[str]) -> tuple[str, dict[str, str]]:
        return f"unset {' '.join(names)}", {key: value for key, value in environment.items() if key not in names}

    for name in given:
        yield without([name])
    if _GPUS in environment:
        yield "export MUJOCO_EGL_DEVICE_ID=0", {**environment, "MUJOCO_EGL_DEVICE_ID": "0"}
    if len(given) > 1:
        yield without(given)
    if environment.get("MUJOCO_GL") != "osmesa":
        to_do, cleared = without([name for name in given if name == "PYOPENGL_PLATFORM"])
        osmesa = "export MUJOCO_GL=osmesa"
        yield f"{to_do}; {osmesa}" if cleared != environment else osmesa, {**cleared, "MUJOCO_GL": "osmesa"}


def _libraries_to_install() -> str:
    absent = {}
    for library, package in _LIBRARIES.items():
        try:
            ctypes.CDLL(library)
        except OSError as error:
            absent[package] = str(error)
    return f"Not to be loaded: {'; '.join(absent.values())}. Install Debian's {' '.join(absent)}." if absent else ""


def _what_to_install() -> str:
    return _libraries_to_install() or (
        "EGL is there and finds no device that draws: on a node with a GPU install the EGL of its driver "
        "(libEGL_nvidia.so.0), elsewhere Mesa's (Debian's libegl-mesa0 and libgl1-mesa-dri); with libosmesa6, "
        "`export MUJOCO_GL=osmesa` draws without EGL."
    )


def _draw_in_a_process(suite: Suite, libero_assets: Path | None, environment: Mapping[str, str]) -> str:
    try:
        done = subprocess.run(
            [sys.executable, "-c", _PROGRAM, suite.kind, str(libero_assets or ""), *sys.path],
            env=dict(environment),
            capture_output=True,
            text=True,
            timeout=_TIMEOUT_S,
            check=False,
        )
    except subprocess.TimeoutExpired:
        raise CannotDraw(f"Nothing can be drawn: no picture came within {_TIMEOUT_S} s.") from None
    try:
        answer = json.loads(done.stdout.splitlines()[-1])
    except (IndexError, ValueError):
        how = f"killed by signal {-done.returncode}" if done.returncode < 0 else f"exit code {done.returncode}"
        last = " ".join(done.stderr.split("\n")[-3:]).strip()
        raise CannotDraw(f"Nothing can be drawn: the process that draws ended with {how} ({last}).") from None
    if "lacks" in answer:
        raise MissingDependency(f"{answer['lacks']} {_libraries_to_install()}".strip())
    if "error" in answer:
        raise CannotDraw(answer["error"])
    return str(answer["renderer"])


def main(kind: str, libero_assets: str) -> None:
    """Draw in this process; prints the renderer, or why nothing was drawn, as a line of JSON."""
    try:
        import_robosuite()
        if kind == "libero":
            load_libero(find_assets(Path(libero_assets) if libero_assets else None))
        answer = {"renderer": _draw()}
    except CannotDraw as error:
        answer = {"error": str(error)}
    except UserError as error:
        answer = {"lacks": str(error)}
    except Exception as error:
        answer = {"error": f"Nothing can be drawn: {first_reason(error)}."}
    print(json.dumps(answer), flush=True)


def _draw() -> str:
    """Draw a box with robosuite's own context; returns the name of what draws."""
    from robosuite.utils.binding_utils import MjRenderContextOffscreen, MjSim

    with readable_device_choice():
        context = MjRenderContextOffscreen(MjSim.from_xml_string(_SCENE), device_id=-1)
    context.render(64, 64, camera_id=0)
    from OpenGL import GL  # type: ignore[import-untyped]

    renderer: str = GL.glGetString(GL.GL_RENDERER).decode()
    if context.read_pixels(64, 64).std() < 1:
        raise CannotDraw(f"{renderer} draws an empty picture.")
    return renderer
