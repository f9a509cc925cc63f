"""Machines on which nothing can be drawn: said in seconds, before a model is loaded, with what mends it."""

from __future__ import annotations

import re
import sys
from collections.abc import Callable, Mapping
from pathlib import Path

import pytest

from tests.kit.thorough import thorough_except
from vla_attention.capture.__main__ import main as capture
from vla_attention.capture.environments.drawing import check_drawing, draw_or_say_what_mends
from vla_attention.capture.environments.robosuite_installation import CannotDraw
from vla_attention.capture.environments.suites import find_suite
from vla_attention.capture.published.evaluate import evaluate
from vla_attention.schemas.errors import MissingDependency

CUBES = find_suite("cubes")
#: Variables with which no machine draws, the reason, and the command that mends it.
BROKEN = [
    ({"MUJOCO_EGL_DEVICE_ID": "99"}, "99 (RuntimeError)", "unset MUJOCO_EGL_DEVICE_ID"),
    ({"CUDA_VISIBLE_DEVICES": "98,99"}, "98 (RuntimeError)", "export MUJOCO_EGL_DEVICE_ID=0"),
    ({"MUJOCO_GL": "elg"}, "elg (RuntimeError)", "unset MUJOCO_GL"),
    (
        {"PYOPENGL_PLATFORM": "osmesa"},
        "PYOPENGL_PLATFORM is 'osmesa' and MUJOCO_GL is 'egl'",
        "unset PYOPENGL_PLATFORM",
    ),
    ({"__EGL_VENDOR_LIBRARY_FILENAMES": "/x.json"}, "(ImportError)", "unset __EGL_VENDOR_LIBRARY_FILENAMES"),
    (
        {"__EGL_VENDOR_LIBRARY_FILENAMES": "/x.json", "MUJOCO_EGL_DEVICE_ID": "99"},
        "EGL_DEVICE_ID=99",
        "unset MUJOCO_EGL_DEVICE_ID __EGL_VENDOR_LIBRARY_FILENAMES",
    ),
]


@pytest.fixture
def environment(monkeypatch: pytest.MonkeyPatch) -> Callable[[Mapping[str, str]], None]:
    """Set variables, and no others that say how to draw."""

    def set_variables(given: Mapping[str, str]) -> None:
        for name in ("MUJOCO_GL", "PYOPENGL_PLATFORM", "MUJOCO_EGL_DEVICE_ID", "CUDA_VISIBLE_DEVICES"):
            monkeypatch.delenv(name, raising=False)
        for name, value in given.items():
            monkeypatch.setenv(name, value)

    return set_variables


@pytest.mark.simulator
@pytest.mark.parametrize(("given", "reason", "to_do"), thorough_except(BROKEN[:1], BROKEN, several=True))
def test_the_first_reason_is_said_and_what_mends_it(environment, given, reason: str, to_do: str):
    environment(given)
    with pytest.raises(CannotDraw) as raised:
        check_drawing(CUBES, None)
    said = str(raised.value)
    assert reason in said
    assert f"Do `{to_do}`: " in said
    assert all(f"{name}={value}" in said for name, value in given.items())


@pytest.mark.simulator
@pytest.mark.parametrize("command", thorough_except(["capture"], ["capture", "evaluate"]))
def test_it_is_said_before_the_model_is_loaded(environment, tmp_path: Path, capfd, command: str):
    environment({"MUJOCO_EGL_DEVICE_ID": "99"})
    words = ["--checkpoint", str(tmp_path / "none"), "--task-suite", "cubes"]
    if command == "capture":
        code = capture(["pi", *words, "--num-envs", "2", "--output", str(tmp_path / "a.zarr")])
    else:
        code = evaluate("evaluate-attention-ratio", [*words, "--output-dir", str(tmp_path / "out")])
    said = capfd.readouterr()
    assert code == 2
    assert ("99" in said.err, "RuntimeError" in said.err) == (True, True), said.err
    assert (said.err.count("\n"), "Traceback" in said.out) == (1, False)
    assert list(tmp_path.rglob("*.zarr")) == []


@pytest.mark.simulator
def test_a_library_that_cannot_be_loaded_is_named_with_its_package(environment, tmp_path: Path, monkeypatch):
    (tmp_path / "libGL.so.1").write_text("no library")
    monkeypatch.setenv("LD_LIBRARY_PATH", str(tmp_path))
    environment({})
    with pytest.raises(MissingDependency, match=r"libGL\.so\.1"):
        check_drawing(CUBES, None)


@pytest.mark.parametrize(
    ("given", "draws", "to_do"),
    [
        ({}, {"MUJOCO_GL": "osmesa"}, "export MUJOCO_GL=osmesa"),
        ({"PYOPENGL_PLATFORM": "egl"}, {"MUJOCO_GL": "osmesa"}, "unset PYOPENGL_PLATFORM; export MUJOCO_GL=osmesa"),
        ({"MUJOCO_GL": "egl"}, {"MUJOCO_GL": "osmesa"}, "export MUJOCO_GL=osmesa"),
        ({"MUJOCO_GL": "osmesa"}, {}, "unset MUJOCO_GL"),
    ],
)
def test_osmesa_is_offered_only_where_it_draws(given: dict[str, str], draws: dict[str, str], to_do: str):
    def draw(environment: Mapping[str, str]) -> str:
        if environment != draws:
            raise CannotDraw("No.")
        return "a renderer"

    with pytest.raises(CannotDraw, match=f"Do `{to_do}`: a renderer"):
        draw_or_say_what_mends(draw, given)

    def refuse(environment: Mapping[str, str]) -> str:
        raise CannotDraw("EGL_BAD_DISPLAY.")

    with pytest.raises(CannotDraw, match=r"^EGL_BAD_DISPLAY\. (?!.*Do `)"):
        draw_or_say_what_mends(refuse, given)


@pytest.mark.parametrize("suite", ["libero_10", "cubes", "robosuite"])
@pytest.mark.parametrize("release", ["1.5.1", "1.3.0"])
def test_another_release_of_robosuite_is_refused(tmp_path: Path, monkeypatch, capfd, suite: str, release: str):
    (tmp_path / "robosuite").mkdir()
    (tmp_path / "robosuite" / "__init__.py").touch()
    (tmp_path / f"robosuite-{release}.dist-info").mkdir()
    (tmp_path / f"robosuite-{release}.dist-info" / "METADATA").write_text(f"Name: robosuite\nVersion: {release}\n")
    monkeypatch.setattr(sys, "path", [str(tmp_path), *sys.path])
    monkeypatch.delitem(sys.modules, "robosuite", raising=False)
    assert capture(["doctor", "--task-suite", suite]) == 1
    said = capfd.readouterr().out
    assert re.search(f"MISSING +robosuite +robosuite {release} ", said)
    assert "pip install robosuite==1.4.0" in said
    words = ["--task-suite", suite, "--output", str(tmp_path / "a.zarr")]
    assert capture(["pi", "--checkpoint", str(tmp_path / "none"), *words]) == 2
    assert f"robosuite {release} " in capfd.readouterr().err
