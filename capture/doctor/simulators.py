"""Whether the simulator of a suite is installed, and LIBERO's assets are where they are looked for."""

from __future__ import annotations

import importlib.util
from pathlib import Path

from vla_attention.capture.doctor.findings import Finding
from vla_attention.capture.doctor.machine import checked
from vla_attention.capture.environments.base import Suite
from vla_attention.capture.environments.libero_installation import find_assets, package_folder
from vla_attention.capture.environments.suites import list_tasks
from vla_attention.schemas.errors import MissingDependency, UserError
from vla_attention.schemas.installing import INSTALL_CAPTURE


def find_simulator(suite: Suite, libero_assets: Path | None) -> list[Finding]:
    """Return the lines about robosuite, LIBERO and its assets; the last two are notes where the suite needs neither."""
    findings = [checked("robosuite", _robosuite)]
    if suite.kind == "libero":
        return [
            *findings,
            checked("LIBERO", lambda: f"{len(list_tasks(suite))} tasks of {suite.name} in {package_folder()}."),
            checked("assets", lambda: f"{find_assets(libero_assets)}."),
        ]
    return [*findings, _not_needed("LIBERO", suite, libero_assets)]


def _robosuite() -> str:
    if importlib.util.find_spec("robosuite") is None:
        raise MissingDependency(f"robosuite is not installed, and simulations need it: {INSTALL_CAPTURE}.")
    from importlib.metadata import version

    return f"robosuite {version('robosuite')}, MuJoCo {version('mujoco')}."


def _not_needed(what: str, suite: Suite, libero_assets: Path | None) -> Finding:
    try:
        text = f"installed in {package_folder()}, assets in {find_assets(libero_assets)}"
    except UserError as error:
        return Finding(what, "note", f"Not needed for the suite {suite.name}. Before its own suites: {error}")
    return Finding(what, "ok", f"Not needed for the suite {suite.name}; {text}.")
