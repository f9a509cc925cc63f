"""Loading robosuite: without its log file, its advice, and its failure on the GPU names of clusters."""

from __future__ import annotations

import contextlib
import importlib.util
import os
import sys
from collections.abc import Iterator
from typing import Any

from vla_attention.schemas.errors import INSTALL_CAPTURE, MissingDependency


def find_robosuite() -> str:
    """Return robosuite's folder without importing it; raise `MissingDependency` if it is not installed."""
    spec = importlib.util.find_spec("robosuite")
    if spec is None or not spec.submodule_search_locations:
        raise MissingDependency(f"robosuite is not installed, and simulations need it: {INSTALL_CAPTURE}.")
    return next(iter(spec.submodule_search_locations))


def import_robosuite() -> None:
    """Import robosuite without its log file and advice; raise `MissingDependency` if it is not installed."""
    if "robosuite" in sys.modules:
        return
    folder = find_robosuite()
    if sys.platform == "linux":
        os.environ.setdefault("MUJOCO_GL", "egl")  # must precede the first import of MuJoCo, which reads it
    # robosuite reads its settings during its import. By default it opens a log file with a fixed name in the common
    # temporary folder. On a shared node that file belongs to its first user, and the import fails for everyone else.
    # The settings module imports nothing, so it can be loaded before the package and changed.
    location = os.path.join(folder, "macros.py")
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
        raise MissingDependency(f"robosuite could not be loaded ({error}): {INSTALL_CAPTURE}.") from error
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
