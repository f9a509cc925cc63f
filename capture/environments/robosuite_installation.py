"""Loading robosuite: without its log file, its advice, and its failure on the GPU names of clusters."""

from __future__ import annotations

import contextlib
import importlib.util
import os
import sys
from collections.abc import Iterator
from importlib.metadata import PackageNotFoundError, version
from typing import Any

from vla_attention.schemas.errors import MissingDependency, UserError
from vla_attention.schemas.install_line import install_line

#: The release that LIBERO is written for. Version 1.5 has other controllers and class names.
_RELEASE = "1.4."
#: What draws where MUJOCO_GL is not set.
DEFAULT_GL = "egl"


class CannotDraw(UserError, RuntimeError):
    """This machine draws no picture as it is set up."""


def find_robosuite() -> str:
    """Return robosuite's folder without importing it.

    Raises:
        MissingDependency: it is not installed, or as another release than simulations here are written for.
    """
    spec = importlib.util.find_spec("robosuite")
    if spec is None or not spec.submodule_search_locations:
        raise MissingDependency(f"robosuite is not installed, and simulations need it: {install_line('capture')}.")
    with contextlib.suppress(PackageNotFoundError):  # a copy of its sources
        if not (found := version("robosuite")).startswith(_RELEASE):
            raise MissingDependency(
                f"robosuite {found} is installed, and LIBERO and all suites here need {_RELEASE}0: in an environment "
                f"of its own, pip install robosuite=={_RELEASE}0."
            )
    return next(iter(spec.submodule_search_locations))


def first_exception(error: BaseException) -> BaseException:
    """Return the exception at the beginning of a chain: those after it mostly come from what it left behind."""
    while (before := error.__cause__ or (None if error.__suppress_context__ else error.__context__)) is not None:
        error = before
    return error


def first_reason(error: BaseException) -> str:
    """Return the first exception of a chain in words, on one line."""
    first = first_exception(error)
    return f"{' '.join(str(first).split()).rstrip('.')} ({type(first).__name__})"


def load_source(name: str, path: str | os.PathLike[str]) -> Any:
    """Run a file of a package as a module without importing the package around it."""
    spec = importlib.util.spec_from_file_location(name, path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def import_robosuite() -> None:
    """Import robosuite without its log file and advice.

    Raises:
        MissingDependency: it is not installed, or something that it imports.
        CannotDraw: it cannot be loaded with the variables that say how to draw.
    """
    if "robosuite" in sys.modules:
        return
    folder = find_robosuite()
    if sys.platform == "linux":
        # Must precede the first import of MuJoCo, which reads it.
        given, platform = os.environ.setdefault("MUJOCO_GL", DEFAULT_GL), os.environ.get("PYOPENGL_PLATFORM")
        if platform and given.lower().strip() in ("egl", "osmesa") and platform.lower() != given.lower().strip():
            raise CannotDraw(
                f"Nothing can be drawn: PYOPENGL_PLATFORM is '{platform}' and MUJOCO_GL is '{given}'; both must name "
                "the same, or only MUJOCO_GL be set."
            )
    # robosuite reads its settings during its import. By default it opens a log file with a fixed name in the common
    # temporary folder. On a shared node that file belongs to its first user, and the import fails for everyone else.
    # The settings module imports nothing, so it can be loaded before the package and changed.
    macros = load_source("robosuite.macros", os.path.join(folder, "macros.py"))
    macros.FILE_LOGGING_LEVEL = None
    macros.CONSOLE_LOGGING_LEVEL = "ERROR"
    sys.modules["robosuite.macros"] = macros
    try:
        with readable_device_choice():
            import robosuite
    except ImportError as error:
        sys.modules.pop("robosuite.macros", None)
        raise MissingDependency(f"robosuite could not be loaded ({error}): {install_line('capture')}.") from error
    except Exception as error:  # MuJoCo's and OpenGL's own, of whatever class
        sys.modules.pop("robosuite.macros", None)
        raise CannotDraw(f"Nothing can be drawn: {first_reason(error)}.") from error
    robosuite.macros = macros


@contextlib.contextmanager
def readable_device_choice() -> Iterator[None]:
    """Hide a CUDA_VISIBLE_DEVICES that robosuite's EGL code cannot parse.

    That code expects a list of EGL device numbers. It fails on GPU or MIG identifiers, on an empty value, and on a
    MUJOCO_EGL_DEVICE_ID outside the list; clusters set all of these.
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
