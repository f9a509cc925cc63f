"""Addresses on the Hugging Face hub: `hf://datasets/ORG/NAME/PATH`, with `@REVISION` after NAME."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace

from vla_attention.schemas.documents import decode_json
from vla_attention.schemas.errors import BadArgument

HUB_PROTOCOL = "hf://"
#: The branch that is read where an address states no revision.
MAIN = "main"
_COMMIT = re.compile(r"[0-9a-f]{40}")


@dataclass(frozen=True)
class HubAddress:
    """A place in a repository of the hub.

    Attributes:
        kind: `datasets`, `spaces` or `models`.
        repository: `ORG/NAME`.
        revision: a commit, or a branch or tag, which may be moved to another commit at any time.
        path: of a file or folder in the repository.
    """

    kind: str
    repository: str
    revision: str
    path: str

    @classmethod
    def of(cls, url: str) -> HubAddress:
        """The parts of an address; raises `BadArgument` for one that names no repository."""
        parts = url.removeprefix(HUB_PROTOCOL).split("/")
        kind = parts.pop(0) if parts[0] in ("datasets", "spaces") else "models"
        name, _, revision = (parts[1] if len(parts) > 1 else "").partition("@")
        if not parts[0] or not name:
            raise BadArgument(f"{url} is no address on the hub; expected hf://datasets/ORG/NAME/PATH.")
        return cls(kind, f"{parts[0]}/{name}", revision or MAIN, "/".join(parts[2:]))

    def __str__(self) -> str:
        at = "" if self.revision == MAIN else f"@{self.revision}"
        return f"{HUB_PROTOCOL}{self._prefix}{self.repository}{at}/{self.path}"

    @property
    def is_commit(self) -> bool:
        """Whether the revision is a commit, whose files never change."""
        return _COMMIT.fullmatch(self.revision) is not None

    def at(self, commit: str) -> HubAddress:
        """The same place at a commit."""
        return replace(self, revision=commit)

    def file_address(self, endpoint: str) -> str:
        """Where the hub at `endpoint` serves the files of this place."""
        return f"{endpoint}/{self._prefix}{self.repository}/resolve/{self._revision}/{self.path}".rstrip("/")

    def revision_address(self, endpoint: str) -> str:
        """Where the hub at `endpoint` says which commit the revision is; without `expand` it lists all files too."""
        return f"{endpoint}/api/{self.kind}/{self.repository}/revision/{self._revision}?expand%5B%5D=sha"

    @property
    def _prefix(self) -> str:
        return "" if self.kind == "models" else f"{self.kind}/"

    @property
    def _revision(self) -> str:
        return self.revision.replace("/", "%2F")


def stated_commit(answer: bytes) -> str | None:
    """The commit in what the hub answers at `HubAddress.revision_address`, None where it states none."""
    try:
        document = decode_json(answer)
    except ValueError:
        return None
    commit = document.get("sha") if isinstance(document, dict) else None
    return commit if isinstance(commit, str) and _COMMIT.fullmatch(commit) else None
