"""Repositories of the Hugging Face hub: names, the local cache, and downloads with the hub's own client.

A name stands for files that their owner may replace at any time. What is downloaded is of one commit, and the store
says which (`downloads`).
"""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from vla_attention.schemas.errors import MissingDependency, UserError, plural
from vla_attention.schemas.install_line import install_line
from vla_attention.schemas.safe_text import plain_stderr

#: `ORG/NAME`, or `ORG/NAME@REVISION` with a commit, a branch or a tag.
HUB_NAME = re.compile(r"([A-Za-z0-9][\w.-]*/[A-Za-z0-9][\w.-]*)(?:@([A-Za-z0-9][\w./-]*))?")
_COMMIT = re.compile(r"[0-9a-f]{40}")
_SNAPSHOTS = "snapshots"
#: Bytes of a download from which on its size is said; files whose sizes are asked for at once.
_WORTH_SAYING, _ASKED_AT_ONCE = 1e8, 500


class CheckpointUnavailable(UserError, ConnectionError):
    """A checkpoint or data set, or a file of it, cannot be downloaded."""


def hub_cache() -> Path:
    """Return the folder that the hub's client downloads to."""
    home = os.environ.get("HF_HOME") or Path(os.environ.get("XDG_CACHE_HOME", "~/.cache")) / "huggingface"
    return Path(os.environ.get("HF_HUB_CACHE") or Path(home) / "hub").expanduser()


def snapshots_folder(repository: str) -> Path:
    """Return the folder for a repository's downloaded versions; it may not exist."""
    return hub_cache() / f"models--{repository.replace('/', '--')}" / _SNAPSHOTS


def in_hub_cache(repository: str, file: str) -> Path | None:
    """Return a file of a repository that was downloaded before, or None.

    Of several versions, that of the branch `main` at its last download is taken, else the first in the order of their
    commits.
    """
    snapshots = snapshots_folder(repository)
    by_commit = {path.relative_to(snapshots).parts[0]: path for path in sorted(snapshots.glob(f"*/{file}"))}
    try:
        newest = (snapshots.parent / "refs" / "main").read_text(encoding="ascii").strip()
    except (OSError, ValueError):
        newest = ""
    return by_commit.get(newest) or next(iter(by_commit.values()), None)


@dataclass(frozen=True)
class HubVersion:
    """A version of a repository: its name, and the commit of its files."""

    repository: str
    commit: str

    def __str__(self) -> str:
        return f"{self.repository}@{self.commit}"


def hub_version(path: Path) -> HubVersion | None:
    """Return which version a file or folder in the hub's cache belongs to, or None for one that is elsewhere."""
    parts = path.absolute().parts
    for folder, above, commit in zip(parts, parts[1:], parts[2:], strict=False):
        kind, _, name = folder.partition("--")
        if above == _SNAPSHOTS and kind in ("models", "datasets") and _COMMIT.fullmatch(commit):
            return HubVersion(name.replace("--", "/", 1), commit)
    return None


def downloads(*paths: Path | None) -> dict[str, str]:
    """Return for a store's provenance which commit of which repository files are of, without those from elsewhere."""
    versions = [hub_version(path) for path in paths if path is not None]
    return {f"hub {version.repository}": version.commit for version in versions if version is not None}


def split_hub_name(name: str) -> tuple[str, str | None] | None:
    """Return repository and revision (None: the newest) of a name on the hub, or None for any other text."""
    match = HUB_NAME.fullmatch(name)
    return None if match is None else (match[1], match[2])


def would_be_fetched(name: str) -> bool:
    """Whether a name is one on the hub rather than a path that exists."""
    return split_hub_name(name) is not None and not Path(name).expanduser().exists()


def local_or_fetched(name: str, patterns: Sequence[str]) -> Path | None:
    """Return a checkpoint: an existing path, or the files of `ORG/NAME` or `ORG/NAME@REVISION`; None for other names.

    Raises what `fetch_from_hub` raises.
    """
    path, on_hub = Path(name).expanduser(), split_hub_name(name)
    if path.exists() or on_hub is None:
        return path if path.exists() else None
    how = (
        f"fetch it where there is a network with `hf download {on_hub[0]}`, copy the folder here and give its path "
        "(there is no such local folder)"
    )
    return fetch_from_hub(on_hub[0], patterns, how, revision=on_hub[1])


def lasting_name(name: str, place: Path) -> str:
    """Return a checkpoint's name with the commit that `place` is of, where it names a repository of the hub.

    Such a name stands for other files tomorrow; with the commit it does not.
    """
    version = None if Path(name).expanduser().exists() else hub_version(place)
    return name if version is None else str(version)


def fetch_from_hub(
    repository: str,
    patterns: Sequence[str],
    how: str,
    kind: Literal["model", "dataset"] = "model",
    revision: str | None = None,
) -> Path:
    """Return the folder of a repository's files that match the patterns, downloaded unless they are in the cache.

    All files of one call are of one commit, which `hub_version` gives; a later call with this commit as its revision
    gives files of the same.

    how: ends an error message with another way to get the files. kind: of the repository. revision: a commit, branch or
    tag; None: the newest. Raises `MissingDependency` without the client, `CheckpointUnavailable` if the download fails.
    """
    try:
        from huggingface_hub import snapshot_download
    except ImportError as error:
        raise MissingDependency(
            f"'{repository}' is a name on the Hugging Face hub, whose client is not installed; install it with "
            f"`{install_line('hub')}`, or {how}."
        ) from error
    try:
        folder = snapshot_download(repository, repo_type=kind, revision=revision, allow_patterns=list(patterns))
    except Exception as error:  # the client's own errors, those of its HTTP library, and OSError
        version = "" if revision is None else f" at '{revision}'"
        raise CheckpointUnavailable(
            f"'{repository}'{version} could not be fetched from the Hugging Face hub ({first_line(error)}); {how}."
        ) from error
    return Path(folder)


def say_download(
    repository: str, files: Sequence[str], kind: Literal["model", "dataset"], revision: str | None
) -> None:
    """Say on stderr how many gigabytes of files are not in the cache, before `fetch_from_hub` downloads them.

    Nothing is said of less than a tenth of a gigabyte, and where the hub does not tell.
    """
    try:
        from huggingface_hub import HfApi, try_to_load_from_cache

        absent = [
            file
            for file in files
            if not isinstance(try_to_load_from_cache(repository, file, revision=revision, repo_type=kind), str)
        ]
        parts = [absent[first : first + _ASKED_AT_ONCE] for first in range(0, len(absent), _ASKED_AT_ONCE)]
        found = [HfApi().get_paths_info(repository, part, revision=revision, repo_type=kind) for part in parts]
        sizes = [getattr(file, "size", 0) for some in found for file in some]
    except Exception:  # the download says what is wrong, in full
        return
    if sum(sizes) >= _WORTH_SAYING:
        what = f"{plural(len(sizes), 'file')}, {sum(sizes) / 1e9:.2g} GB, of {repository}"
        print(f"Downloading {what} to {hub_cache()}.", file=plain_stderr(), flush=True)


def first_line(error: BaseException) -> str:
    """Return an error in one line, for a message: its class and the first line of its text."""
    text = str(error).strip()
    return f"{type(error).__name__}: {text.splitlines()[0].rstrip('.')}" if text else type(error).__name__
