"""Checkpoint folders of any family: the errors that they can cause, and reading their JSON files."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from vla_attention.schemas.errors import UserError


class CheckpointNotFound(UserError, FileNotFoundError):
    """There is no checkpoint, or not all of it."""


class UnsupportedCheckpoint(UserError, ValueError):
    """The folder is no checkpoint, or a checkpoint of another kind or form."""


class UnreadableCheckpoint(UserError, ValueError):
    """The folder has the right files, but one of them is damaged."""


class CheckpointMismatch(UserError, ValueError):
    """The checkpoint's tensors are not those of the model: names or shapes differ."""


def read_json_object(path: Path) -> dict[str, Any]:
    """Read a JSON file that holds an object; anything else is an `UnreadableCheckpoint`."""
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise UnreadableCheckpoint(f"There is no '{path}', which the checkpoint needs.") from None
    except (ValueError, OSError) as error:
        raise UnreadableCheckpoint(f"'{path}' is not valid JSON ({error}).") from error
    if not isinstance(content, dict):
        raise UnreadableCheckpoint(f"'{path}' should hold a JSON object, but holds a {type(content).__name__}.")
    return content
