"""Checks of the machine, on made-up machines: each line says how it stands and what to do."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from vla_attention.capture.doctor.machine import (
    Finding,
    checked,
    find_drawing,
    find_gpu,
    find_memory,
    find_precision,
    find_processor,
    find_simulator,
    something_missing,
)
from vla_attention.capture.environments.libero_installation import ASSET_SUBFOLDERS, ASSETS_VARIABLE
from vla_attention.capture.environments.suites import find_suite
from vla_attention.schemas.errors import BadArgument
from vla_attention.schemas.threads import Threads

GIGABYTE = 10**9


def torch_with(gpus: int, cuda: str | None = "12.8", bfloat16: bool = True) -> Any:
    """Something like torch on a machine with that many GPUs."""
    properties = SimpleNamespace(name="NVIDIA H100", major=9, minor=0)
    return SimpleNamespace(
        __version__="2.8.0",
        version=SimpleNamespace(cuda=cuda),
        cuda=SimpleNamespace(
            is_available=lambda: gpus > 0,
            get_device_properties=lambda device: properties,
            mem_get_info=lambda device: (70 * GIGABYTE, 80 * GIGABYTE),
            is_bf16_supported=lambda including_emulation: bfloat16,
        ),
    )


def test_a_line_has_the_status_what_was_looked_at_and_what_to_do():
    assert Finding("GPU", "ok", "There.").describe() == "ok       GPU         There."
    missing = Finding("assets", "missing", "None.", "Get them.")
    assert missing.describe() == "MISSING  assets      None. Get them."
    assert something_missing([missing])
    assert not something_missing([Finding("a", "ok", ""), Finding("b", "note", "")])


def test_more_threads_than_processors_is_a_note():
    assert find_processor(Threads(1, "--threads")).status == "ok"
    many = find_processor(Threads(100_000, "--threads"))
    assert (many.status, "--threads " in many.to_do) == ("note", True)


def test_memory(tmp_path: Path):
    meminfo = tmp_path / "proc" / "meminfo"
    meminfo.parent.mkdir()
    meminfo.write_text("MemTotal:  9 kB\nMemAvailable:    2000000 kB\n", encoding="ascii")
    assert find_memory(tmp_path).describe() == "ok       memory      2.05 GB available, by what the machine leaves."
    assert find_memory(tmp_path / "none").status == "note"


def test_a_gpu_is_described():
    found = find_gpu("auto", torch_with(1))
    assert found.status == "ok"
    assert found.text == ("NVIDIA H100, 70 GB of 80 GB free, compute capability 9.0, torch 2.8.0 with CUDA 12.8.")
    unused = find_gpu("cpu", torch_with(1))
    assert (unused.status, unused.text.endswith("--device cpu leaves it unused.")) == ("note", True)


@pytest.mark.parametrize(
    ("cuda", "driver", "said"),
    [
        (None, False, "is built without CUDA"),
        ("12.8", True, "finds none, though there is a driver"),
        ("12.8", False, "there is no NVIDIA driver"),
    ],
)
def test_without_a_gpu_the_reason_is_given(tmp_path: Path, cuda: str | None, driver: bool, said: str):
    version = tmp_path / "version"
    if driver:
        version.write_text("550", encoding="ascii")
    for device, status in (("auto", "note"), ("cpu", "note"), ("cuda:0", "missing")):
        found = find_gpu(device, torch_with(0, cuda), version)
        assert (found.status, said in found.text) == (status, True)
        assert found.to_do


def test_precision(tmp_path: Path):
    cpuinfo = tmp_path / "cpuinfo"
    cpuinfo.write_text("flags\t\t: fpu avx2 avx512f\n", encoding="ascii")
    assert find_precision("float32", "cpu", torch_with(0), cpuinfo).status == "ok"
    slow = find_precision("bfloat16", "cpu", torch_with(0), cpuinfo)
    assert (slow.status, "no instructions for it" in slow.text) == ("note", True)
    cpuinfo.write_text("flags\t\t: fpu amx_bf16\n", encoding="ascii")
    assert find_precision("bfloat16", "cpu", torch_with(0), cpuinfo).status == "ok"
    assert find_precision("bfloat16", "cuda", torch_with(1), cpuinfo).status == "ok"
    assert find_precision("bfloat16", "cuda", torch_with(1, bfloat16=False), cpuinfo).status == "note"


@pytest.mark.parametrize(
    ("code", "output", "errors", "status", "said"),
    [
        (0, '{"renderer": "NVIDIA H100/PCIe/SSE2", "varies": true}\n', "", "ok", "draws with NVIDIA H100"),
        (0, 'advice\n{"renderer": "llvmpipe (LLVM 15)", "varies": true}\n', "", "note", "That is the processor."),
        (0, '{"renderer": "NVIDIA H100", "varies": false}\n', "", "missing", "The picture is empty."),
        (1, "", "Traceback\nImportError: Cannot initialize EGL\n", "missing", "(ImportError: Cannot initialize EGL)"),
        (-11, "", "", "missing", "the process ended with code -11"),
    ],
)
def test_drawing(monkeypatch, code: int, output: str, errors: str, status: str, said: str):
    monkeypatch.delenv("MUJOCO_GL", raising=False)
    given = []

    def run(program: str, environment: Any) -> tuple[int, str, str]:
        given.append(environment["MUJOCO_GL"])
        return code, output, errors

    found = find_drawing(run)
    assert given == ["egl"]
    assert (found.status, said in found.text) == (status, True)
    assert bool(found.to_do) is (status != "ok")


@pytest.mark.simulator
def test_a_picture_is_really_drawn():
    found = find_drawing()
    assert found.status in ("ok", "note"), found.describe()
    assert "draws with" in found.text


def test_a_mistake_of_a_check_is_its_sentence():
    def fail() -> str:
        raise BadArgument("This is wrong; do that.")

    assert checked("a", fail) == Finding("a", "missing", "This is wrong; do that.")
    assert checked("a", lambda: "Fine.") == Finding("a", "ok", "Fine.")


def test_assets_are_missing_only_where_the_suite_needs_them(tmp_path: Path, monkeypatch):
    monkeypatch.delenv(ASSETS_VARIABLE, raising=False)
    empty, whole = tmp_path / "empty", tmp_path / "whole"
    empty.mkdir()
    for name in ASSET_SUBFOLDERS:
        (whole / name).mkdir(parents=True)
    by_name = {finding.what: finding for finding in find_simulator(find_suite("libero_10"), empty)}
    assert by_name["LIBERO"].status == "ok"
    assert (by_name["assets"].status, "lacks scenes" in by_name["assets"].text) == ("missing", True)
    assert not something_missing(find_simulator(find_suite("libero_10"), whole))
    assert not something_missing(find_simulator(find_suite("cubes"), empty))
