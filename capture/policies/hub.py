"""Repositories of the Hugging Face hub: names, the local cache, and downloads with the hub's own client."""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Literal

from vla_attention.schemas.errors import MissingDependency, UserError

#: `ORG/NAME`.
HUB_NAME = re.compile(r"[A-Za-z0-9][\w.-]*/[A-Za-z0-9][\w.-]*")


class CheckpointUnavailable(UserError, ConnectionError):
    """A checkpoint or data set, or a file of it, cannot be downloaded."""


def hub_cache() -> Path:
    """Return the folder that the hub's client downloads to."""
    home = os.environ.get("HF_HOME") or Path(os.environ.get("XDG_CACHE_HOME", "~/.cache")) / "huggingface"
    return Path(os.environ.get("HF_HUB_CACHE") or Path(home) / "hub").expanduser()


def snapshots_folder(repository: str) -> Path:
    """Return the folder for a repository's downloaded versions; it may not exist."""
    return hub_cache() / f"models--{repository.replace('/', '--')}" / "snapshots"


def fetch_from_hub(
    repository: str, patterns: Sequence[str], how: str, kind: Literal["model", "dataset"] = "model"
) -> Path:
    """Return the folder of a repository's files that match the patterns, downloaded unless they are in the cache.

    how: ends an error message with another way to get the files. kind: of the repository. Raises `MissingDependency`
    without the client, `CheckpointUnavailable` if the download fails.
    """
    try:
        from huggingface_hub import snapshot_download
    except ImportError as error:
        raise MissingDependency(
            f"'{repository}' is a name on the Hugging Face hub, whose client is not installed; install it with "
            f"`pip install 'vla-attention[hub]'`, or {how}."
        ) from error
    try:
        return Path(snapshot_download(repository, repo_type=kind, allow_patterns=list(patterns)))
    except Exception as error:  # the client's own errors, those of its HTTP library, and OSError
        raise CheckpointUnavailable(
            f"'{repository}' could not be fetched from the Hugging Face hub ({first_line(error)}); {how}."
        ) from error


def first_line(error: BaseException) -> str:
    """Return an error in one line, for a message: its class and the first line of its text."""
    text = str(error).strip()
    return f"{type(error).__name__}: {text.splitlines()[0].rstrip('.')}" if text else type(error).__name__
