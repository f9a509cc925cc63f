"""Build the source distribution and from it the wheel, install the wheel outside the checkout, and use it there.

Usage: python scripts/check_package.py [--folder FOLDER] [--release | --newest [PYTHON ...]]

Two environments are made in a temporary folder, or in FOLDER, which is then kept. "laptop" is clean: the wheel and its
dependencies. "node" is the wheel on top of the libraries of the environment that runs this script, so that a policy
can run without a second copy of torch. A store is captured in "node" and analysed in "laptop". The packages are built
from a copy of the checkout, in which the README's relative links are absolute. Exit code 1: a check failed.

With --release, also: no placeholder is left and CHANGELOG.md has the date, the commit's tag fits, `twine check` finds
nothing (it brings 25 packages, into an environment of its own), and what `pip install vla-attention` takes today shows
the example stores on each of Python 3.11 to 3.13 that is there: 40 seconds each.

With --newest, instead: on each of these interpreters, or those that are named, what `pip install
'vla-attention[capture]'` takes today, without the versions of scripts/constraints.txt, records an episode and analyses
it. torch may bring CUDA's libraries, several gigabytes for each interpreter.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import shutil
import subprocess
import sys
import sysconfig
import tarfile
import tempfile
import tomllib
import zipfile
from pathlib import Path, PurePosixPath
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = "vla_attention"
#: Folders of the checkout that are no part of its source.
LEFT_OUT = shutil.ignore_patterns(".*", "build", "dist", "*.egg-info", "__pycache__", "runs", "results", "node_modules")
#: What the wheel, other than the source distribution, has no use for: the viewer's page is built.
SOURCES_OF_THE_PAGE = f"{PACKAGE}/analyze/view/web/"
#: What stands at the top of the source distribution.
TOP_OF_SDIST = {
    PACKAGE,
    f"{PACKAGE}.egg-info",
    "CHANGELOG.md",
    "CONTRIBUTING.md",
    "LICENSE",
    "MANIFEST.in",
    "Makefile",
    "PKG-INFO",
    "README.md",
    "benchmarks",
    "docs",
    "examples",
    "pyproject.toml",
    "scripts",
    "setup.cfg",
    "tests",
}
#: Run in an environment, outside the checkout; prints the version. Imports of the folders' own names must fail.
CHECK_IMPORTS = """
import importlib.util, sys
import vla_attention as va
heavy = [name for name in ("torch", "zarr", "polars", "numpy", "matplotlib") if name in sys.modules]
assert not heavy, f"import vla_attention loads {heavy}"
bare = [name for name in ("analyze", "capture", "schemas", "tests", "examples") if importlib.util.find_spec(name)]
assert not bare, f"these names can be imported beside vla_attention: {bare}"
assert all(hasattr(va, name) for name in va.__all__), va.__all__
print(va.__version__, va.__file__)
"""

#: Stands for what nobody has decided yet: the author, and the address of the repository.
PLACEHOLDER = "OWNER"
#: A link or a picture in Markdown whose address leads nowhere outside the checkout.
RELATIVE_LINK = re.compile(r"(!?)(\[[^\[\]]*\]\()(?![a-z]+:|#)")
#: Pythons on which what `pip install` takes by itself is held against the wheel.
PYTHONS = ("3.11", "3.12", "3.13")
#: Prints the versions of Python and of those of the named libraries that are installed.
PRINT_VERSIONS = """
import platform, sys
from importlib.metadata import distributions
there = sorted((found.name, found.version) for found in distributions() if found.name in sys.argv)
print("Python", platform.python_version(), *(word for pair in there for word in pair))
"""
LIBRARIES = ("zarr", "numcodecs", "numpy", "polars", "matplotlib", "torch", "mujoco")


class CheckFailed(Exception):
    """A check of the package did not hold."""


def main() -> int:
    """Run all checks; returns the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--folder", type=Path, help="folder for packages and environments, kept afterwards")
    which = parser.add_mutually_exclusive_group()
    which.add_argument("--release", action="store_true", help="also refuse what must not be uploaded")
    which.add_argument(
        "--newest", nargs="*", metavar="PYTHON", help="the newest libraries instead, on these interpreters or all"
    )
    arguments = parser.parse_args()
    given = arguments.folder
    with tempfile.TemporaryDirectory(prefix="package_") as temporary:
        folder = Path(temporary) if given is None else given.resolve()
        try:
            check_release(arguments.release)
            wheel = build_packages(folder)
            if arguments.newest is None:
                laptop, node = make_environments(wheel, folder)
                use_packages(laptop, node, folder)
            else:
                use_newest(wheel, "[capture]", arguments.newest or interpreters(), folder)
            if arguments.release:
                check_metadata(wheel.parent)
                use_newest(wheel, "", interpreters(), folder)
        except CheckFailed as error:
            print(f"package check failed: {error}", file=sys.stderr)
            return 1
    print("package check passed")
    return 0


def project() -> dict[str, Any]:
    """Return what pyproject.toml says of the package."""
    with open(ROOT / "pyproject.toml", "rb") as file:
        return tomllib.load(file)["project"]


def version() -> str:
    """Return the package's version."""
    return project()["version"]


def check_release(refuse: bool) -> None:
    """Say what is left to write before a release, or refuse it, and a commit whose tag is not that of the version."""
    left = [
        f"{name} line {number} ({line.split()[0]})"
        for name in ("pyproject.toml", "docs/install.md")
        for number, line in enumerate((ROOT / name).read_text(encoding="utf-8").splitlines(), 1)
        if PLACEHOLDER in line
    ]
    points = [f"the placeholder {PLACEHOLDER} stands in {', '.join(left)}"] if left else []
    heading = f"## {version()} "
    if not re.search(rf"^{re.escape(heading)}\(\d{{4}}-\d\d-\d\d\)$", (ROOT / "CHANGELOG.md").read_text(), re.M):
        points.append(f"CHANGELOG.md has no heading '{heading}(YYYY-MM-DD)'")
    check(not (refuse and points), f"not to be released: {'; '.join(points)}")
    if points:
        print(f"before a release (--release refuses): {'; '.join(points)}")
    if refuse:
        git = ("git", "-C", ROOT)
        tags, ours = (
            run(*git, "tag", "--list", *which, quiet=True).split()
            for which in (("v*", "--points-at", "HEAD"), (f"v{version()}",))
        )
        found = f"this commit has the tags {tags}, and the checkout {ours}"
        check(tags == ours, f"expected the tag v{version()} on this commit, or none yet; {found}.")
        changed = run(*git, "status", "--porcelain", quiet=True)
        check(not changed, f"a release is made from a commit, which lacks these files; commit them:\n{changed}")


def check_metadata(packages: Path) -> None:
    """Let twine look at what an index would be sent."""
    environment = packages.parent / "twine"
    run(sys.executable, "-m", "venv", "--clear", environment)
    run(environment / "bin/python", "-m", "pip", "install", "--quiet", "twine")
    run(environment / "bin/twine", "check", "--strict", *packages.iterdir())


def build_packages(folder: Path) -> Path:
    """Build both packages from a copy of the checkout and check their files; returns the wheel's path."""
    source, built = folder / "source", folder / "dist"
    outside = not folder.is_relative_to(ROOT) or folder.is_relative_to(ROOT / "build")
    check(outside, f"{folder} is in the checkout, which is copied there; give a folder outside, or one in build/")
    check(not folder.is_file(), f"{folder} is a file; give a folder")
    folder.mkdir(parents=True, exist_ok=True)
    for old in (source, built):
        shutil.rmtree(old, ignore_errors=True)
    shutil.copytree(ROOT, source, symlinks=True, ignore=LEFT_OUT)
    write_addresses(source / "README.md")
    output = run(sys.executable, "-m", "build", "--outdir", built, source, quiet=True)
    # PYTHONDONTWRITEBYTECODE is no reason to stop, nor that the copy holds no compiled file to be left out.
    harmless = "byte-compiling is disabled|no previously-included files matching '(?:\\*\\.py\\[cod\\]|__pycache__)'"
    warned = re.findall(rf"^(?:WARNING |.*arning: )(?!.*(?:{harmless})).*", output, re.M)
    check(not warned, "the build warns:\n" + "\n".join(warned))
    (sdist,), (wheel,) = built.glob("*.tar.gz"), built.glob("*.whl")
    expected = source_files(source / PACKAGE)

    with tarfile.open(sdist) as archive:
        members = {PurePosixPath(*PurePosixPath(item.name).parts[1:]): item for item in archive if not item.isdir()}
    links = [str(path) for path, item in members.items() if not item.isfile()]
    check(not links, f"{sdist.name} holds links: {links}")
    compare(f"top of {sdist.name}", {path.parts[0] for path in members}, TOP_OF_SDIST)
    compare(f"{PACKAGE}/ in {sdist.name}", {str(path) for path in members if path.parts[0] == PACKAGE}, expected)

    with zipfile.ZipFile(wheel) as archive:
        names = {name for name in archive.namelist() if not name.endswith("/")}
        about = {PurePosixPath(name).name: archive.read(name).decode() for name in names if ".dist-info/" in name}
    compare("top_level.txt of the wheel", set(about["top_level.txt"].split()), {PACKAGE})
    relative = re.findall(r"\]\((?!https:)[^)]*\)|(?:src|href)=.(?!https:)[^>]*", about["METADATA"])
    check(not relative, f"an index shows the README, where these lead nowhere: {relative}")
    expected = {name for name in expected if not name.startswith(SOURCES_OF_THE_PAGE)}
    compare(wheel.name, {name for name in names if ".dist-info/" not in name}, expected)
    print(f"built {sdist.name} and from it {wheel.name}: {len(expected)} files in {PACKAGE}/, nothing beside it")
    return wheel


def write_addresses(readme: Path) -> None:
    """Make a README's relative links absolute: to this version's tag in the repository."""
    pages = f"{project()['urls']['Repository']}/blob/v{version()}/"
    pictures = pages.replace("//github.com/", "//raw.githubusercontent.com/").replace("/blob/", "/")
    text = readme.read_text(encoding="utf-8")
    text = RELATIVE_LINK.sub(lambda link: link[0] + (pictures if link[1] else pages), text)
    readme.write_text(text, encoding="utf-8")


def source_files(package: Path) -> set[str]:
    """Every file of the package, relative to the folder above it, through the symbolic links to its sub-packages."""
    return {
        str(Path(folder, name).relative_to(package.parent))
        for folder, _, names in os.walk(package, followlinks=True)
        for name in names
    }


def make_environments(wheel: Path, folder: Path) -> tuple[Path, Path]:
    """Install the wheel into two new environments; returns their folders of commands ("laptop", "node")."""
    laptop, node = folder / "laptop", folder / "node"
    for environment in (laptop, node):
        run(sys.executable, "-m", "venv", "--clear", "--without-pip", environment)
    pip = (sys.executable, "-m", "pip", "--quiet", "--disable-pip-version-check")
    run(*pip, "--python", laptop / "bin/python", "install", "--constraint", ROOT / "scripts/constraints.txt", wheel)
    run(*pip, "--python", node / "bin/python", "install", "--no-deps", wheel)
    (libraries,) = node.glob("lib/python*/site-packages")
    # A folder named in a .pth file is searched after the environment's own, and .pth files in it (editable installs)
    # are not read.
    (libraries / "libraries.pth").write_text(sysconfig.get_path("purelib") + "\n")
    return laptop / "bin", node / "bin"


def use_packages(laptop: Path, node: Path, folder: Path) -> None:
    """Import, ask for help, capture and analyse, with the installed wheel and outside the checkout."""
    for commands in (laptop, node):
        imported = run(commands / "python", "-I", "-c", CHECK_IMPORTS, cwd=folder, quiet=True).split()
        check(imported[0] == version(), f"the version is {imported[0]}, not {version()}")
        check(Path(imported[1]).is_relative_to(commands.parent), f"{imported[1]} is not the installed wheel")
        for script in project()["scripts"]:
            run(commands / script, "--help", cwd=folder, quiet=True)

    use_examples(laptop, folder)
    capture_and_analyse(laptop, node, folder)
    ask_a_data_set(laptop, folder)


def capture_and_analyse(laptop: Path, node: Path, folder: Path) -> None:
    """Record an episode with one environment's commands, and analyse it with another's."""
    store, output = folder / "store.zarr", folder / "results"
    for old in (store, output):
        shutil.rmtree(old, ignore_errors=True)
    short = ("--task-id", 0, "--num-episodes", 1, "--replan-steps", 4, "--max-steps", 8)
    # The default: the trained policy that is part of the package, and its suite.
    run(node / "python", "-m", f"{PACKAGE}.capture", "pi", *short, "--output", store, cwd=folder, quiet=True)
    code = json.loads((store / "zarr.json").read_text())["attributes"]["provenance"]["code"]
    check(code == version(), f"the store was made by code version {code}, expected {version()}")
    run(node / "vla-attention", "capture", "slurm", folder / "batch", cwd=folder, quiet=True)
    check((folder / "batch/submit_attention_ratio.sh").is_file(), "capture slurm wrote no scripts")
    run(laptop / "vla-attention", "analyze", store, "--output", output, cwd=folder, quiet=True)
    run(laptop / "python", "-m", f"{PACKAGE}.analyze", "store", "verify", store, cwd=folder, quiet=True)
    run(laptop / "vla-attention", "report", store, "--output", output / "report.html", cwd=folder, quiet=True)
    written = sorted(path.suffix for path in output.rglob("*") if path.is_file())
    check({".json", ".parquet", ".png", ".html"} <= set(written), f"the analysis wrote only {written}")
    results = sorted(output.rglob("attention_ratio_results*.json"))
    check(len(results) == 1, f"expected one results file in {output}, found {results}")
    run(laptop / "parse-attention-ratio-results", "--results", results[0], cwd=folder, quiet=True)
    print("captured a store and analysed it with the installed wheel")


def ask_a_data_set(laptop: Path, folder: Path) -> None:
    """With the extra `datasets` and without torch, ask a data set with videos what its first pictures tell."""
    sys.path.insert(0, str(ROOT))
    from tests.kit.lerobot_data_sets import H264, made_up_episodes, write_data_set

    shutil.rmtree(folder / "data_set", ignore_errors=True)
    write_data_set(folder / "data_set", "v3.0", made_up_episodes((3,) * 12), video=H264)
    (av,) = project()["optional-dependencies"]["datasets"]
    run(sys.executable, "-m", "pip", "--quiet", "--python", laptop / "python", "install", av, quiet=True)
    command = (laptop / "vla-attention", "data", "data_set", "--output", "of_data_set")
    answer = run(*command, cwd=folder, quiet=True)
    check("Must a policy read the sentence here?" in answer, f"asked of a data set, it says: {answer}")


def interpreters() -> list[str]:
    """Return those of `PYTHONS` that run on this machine; prints which are missing."""
    found = {python: run("sh", ROOT / "scripts/find_python.sh", python, quiet=True).strip() for python in PYTHONS}
    missing = [python for python, path in found.items() if not path]
    if missing:
        print(f"not checked, since it is neither on PATH nor in ~/.pyenv or /opt: Python {', '.join(missing)}")
    check(len(missing) < len(PYTHONS), "no Python to check with is there; name one: --newest PYTHON")
    return [path for path in found.values() if path]


def use_newest(wheel: Path, extra: str, pythons: list[str], folder: Path) -> None:
    """On each interpreter, install the wheel without constraints; record an episode, or show the examples."""
    for python in pythons:
        check(shutil.which(python) is not None, f"{python} runs no Python.")
        environment = folder / "newest"
        run(python, "-m", "venv", "--clear", environment)
        pip = (environment / "bin/python", "-m", "pip", "--quiet", "--disable-pip-version-check")
        run(*pip, "install", f"{wheel}{extra}", quiet=True)
        print(run(environment / "bin/python", "-c", PRINT_VERSIONS, *LIBRARIES, quiet=True).strip())
        if extra:
            capture_and_analyse(environment / "bin", environment / "bin", folder)
        else:
            use_examples(environment / "bin", folder)
        shutil.rmtree(environment)


def use_examples(laptop: Path, folder: Path) -> None:
    """What a first minute has: the stores that are shipped, by the one name that `uvx` knows, and no torch."""
    examples = folder / "example"
    shutil.rmtree(examples, ignore_errors=True)
    run(laptop / "vla-attention", "example", examples, cwd=folder, quiet=True)
    answer = run(laptop / "vla-attention", "analyze", examples / "cubes.zarr", "--output", folder / "first", quiet=True)
    check("Looks or reads?" in answer, f"the example's analysis says: {answer}")
    refused = subprocess.run(
        [laptop / "vla-attention", "capture", "pi"], cwd=folder, text=True, capture_output=True, check=False
    )
    sentence = refused.stderr.strip()
    check(
        refused.returncode == 2 and "pip install 'vla-attention[capture] @ file:" in sentence and "\n" not in sentence,
        f"without torch, capture ends with {refused.returncode} and: {sentence}",
    )


def run(*command: object, cwd: Path | None = None, quiet: bool = False) -> str:
    """Run a command without the checkout on Python's path.

    `quiet`: its output is returned, and shown only when the command fails.

    Raises:
        CheckFailed: it ended with another exit code than 0.
    """
    words = [str(word) for word in command]
    environment = {name: value for name, value in os.environ.items() if name not in ("PYTHONPATH", "PYTHONHOME")}
    done = subprocess.run(words, cwd=cwd, env=environment, text=True, capture_output=quiet, check=False)
    output = f"{done.stdout}{done.stderr}" if quiet else ""
    check(not done.returncode, f"exit code {done.returncode} of: {' '.join(words)}\n{output}")
    return output


def check(holds: bool, message: str) -> None:
    """Raise `CheckFailed` with the message unless the condition holds."""
    if not holds:
        raise CheckFailed(message)


def compare(what: str, found: set[str], expected: set[str]) -> None:
    """Raise `CheckFailed` that lists what is missing and what is too much."""
    missing, extra = sorted(expected - found), sorted(found - expected)
    check(not missing and not extra, f"{what}: missing {missing}, not expected {extra}")


if __name__ == "__main__":
    sys.exit(main())
