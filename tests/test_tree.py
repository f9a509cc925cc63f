"""What is tracked: nothing that a run left behind, at the top or among the stores."""

from __future__ import annotations

import subprocess

import pytest

from tests.kit.paths import ROOT

TOP = {
    ".ci", ".github", ".gitignore", "CHANGELOG.md", "CONTRIBUTING.md", "LICENSE", "MANIFEST.in", "Makefile",
    "README.md", "analyze", "benchmarks", "capture", "docs", "examples", "pyproject.toml", "schemas", "scripts",
    "tests", "vla_attention",
}  # fmt: skip


@pytest.fixture(scope="module")
def tracked():
    if not (ROOT / ".git").exists():
        pytest.skip("not a checkout of git: nothing says which files are tracked")
    listed = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, text=True, check=True)
    return listed.stdout.split("\0")[:-1]


def test_the_top_has_these_entries_and_no_others(tracked):
    assert sorted({name.split("/")[0] for name in tracked}) == sorted(TOP)


def test_no_store_is_tracked(tracked):
    assert [name for name in tracked if ".zarr/" in name] == []


def test_no_results_of_a_run_are_tracked(tracked):
    left = [name for name in tracked if name.split("/")[-2:-1] in (["results"], ["runs"]) or name.endswith(".partial")]
    assert left == []
