"""Outcomes that were told after the recording, by a scorer or a person: one file beside the sealed episodes.

Each is bound to the seal under which its episode was captured: one that is recorded again has another seal, and the
outcome of the first is not its own.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path

from vla_attention.schemas.jsonable import Document, decode_json, from_json, to_json
from vla_attention.schemas.stores.digest import root_digest, with_digest
from vla_attention.schemas.stores.durable_files import publish_file
from vla_attention.schemas.stores.remote_source import RemoteFailure, source_of
from vla_attention.schemas.stores.store_format import StoreError
from vla_attention.schemas.stores.store_url import StorePlace

OUTCOMES_FILE = "outcomes.json"


class LaterOutcome(Document, frozen=True):
    """Whether an episode was solved; `seal` is the digest of the seal under which it was captured."""

    success: bool
    seal: str


class LaterOutcomes(Document, frozen=True):
    """The file: outcomes by the episode's name. `digest` is the sha256 of the rest, as a root's is."""

    outcomes: dict[str, LaterOutcome]
    digest: str


def read_outcomes(path: StorePlace) -> dict[str, LaterOutcome]:
    """The outcomes of the store at a place that were told after its recording, by episode; most stores have none.

    Raises:
        StoreError: the file is damaged.
    """
    try:
        document = decode_json(source_of(path).whole(OUTCOMES_FILE))
        found = from_json(LaterOutcomes, document)
        if found.digest != root_digest(document):
            raise ValueError("its own digest does not fit")
    except RemoteFailure:
        raise
    except (FileNotFoundError, NotADirectoryError):
        return {}
    except (OSError, ValueError) as error:
        why = str(error).rstrip(".")
        raise StoreError(
            f"The store {path} cannot be read: its {OUTCOMES_FILE}, of outcomes that were told later: {why}. Tell them "
            f"anew: vla-attention store outcomes {path} --remove, then with the file of outcomes."
        ) from None
    return found.outcomes


def write_outcomes(store: Path, building: Path, outcomes: Mapping[str, LaterOutcome]) -> None:
    """Write the file of a store, in place of the one that it has; `building` is a folder beside the store."""
    if not outcomes:
        (store / OUTCOMES_FILE).unlink(missing_ok=True)
        return
    document = with_digest({"outcomes": to_json(dict(sorted(outcomes.items())))})
    (building / OUTCOMES_FILE).write_bytes(json.dumps(document, indent=1).encode())
    publish_file(building / OUTCOMES_FILE, store / OUTCOMES_FILE)
