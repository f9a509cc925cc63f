"""Find a checkpoint and a tokenizer: on disk, in the caches of openpi and the Hugging Face hub, or on the hub.

Downloads go into the caches of the ecosystem's own tools, so that nothing is downloaded twice. Without a network or a
client, the error names the files and the place for them.
"""

from __future__ import annotations

import os
from pathlib import Path

from vla_attention.capture.policies.checkpoints import CheckpointNotFound
from vla_attention.schemas.errors import BadArgument, listing
from vla_attention.schemas.hub import (
    CheckpointUnavailable,
    in_hub_cache,
    local_or_fetched,
    snapshots_folder,
)
from vla_attention.schemas.safe_text import check_inner_path

#: Files of a hub repository that a policy needs; only these are downloaded.
HUB_FILES = (
    "config.json",
    "model*.safetensors",
    "model.safetensors.index.json",
    "adapter_config.json",
    "policy_*.json",
    "policy_*.safetensors",
    "assets/**",
    "tokenizer/**",
    "*.model",
)
#: openpi's published checkpoints, in its bucket and below its cache.
OPENPI_CHECKPOINTS = "openpi-assets/checkpoints"

TOKENIZER_NAME = "paligemma_tokenizer.model"
TOKENIZER_URL = "gs://big_vision/paligemma_tokenizer.model"
#: Hub repository of the tokenizer in LeRobot's policies; its licence has to be accepted before a download.
TOKENIZER_REPOSITORY = "google/paligemma-3b-pt-224"


def find_checkpoint(name: str) -> Path:
    """Return the folder of a checkpoint.

    It is a local folder, `gs://...` in openpi's cache, or `ORG/NAME` or `ORG/NAME@COMMIT` of the hub, which is
    downloaded where the hub's cache lacks it. `CheckpointUnavailable` or `MissingDependency` if it cannot be had,
    `CheckpointNotFound` for a path or another name that leads nowhere.
    """
    if name.startswith("gs://"):
        return _from_openpi_cache(name.rstrip("/"))
    found = local_or_fetched(name, HUB_FILES)
    if found is None:
        path = Path(name).expanduser()
        raise CheckpointNotFound(f"There is no checkpoint folder at '{path}'.{_where_else(path)}")
    return found


def _where_else(path: Path) -> str:
    """Return where a checkpoint of openpi is whose path leads nowhere: a name alone, or a place in openpi's cache."""
    published = openpi_cache() / OPENPI_CHECKPOINTS
    place = (published / path if len(path.parts) == 1 else path).absolute()
    if place.parent != published.absolute() or not place.name.startswith("pi"):
        return ""
    address = f"gs://{OPENPI_CHECKPOINTS}/{place.name}"
    if place.is_dir():
        return f" openpi's cache has one of this name: give '{place}' or {address}."
    return f" openpi's checkpoints have addresses: give {address}, once it is in its cache, '{place}'."


def openpi_cache() -> Path:
    """Return the folder that openpi downloads to: OPENPI_DATA_HOME, else ~/.cache/openpi."""
    return Path(os.environ.get("OPENPI_DATA_HOME", "~/.cache/openpi")).expanduser()


def _from_openpi_cache(url: str) -> Path:
    inner = url.removeprefix("gs://")
    check_inner_path(inner)
    target = openpi_cache() / inner
    if not target.is_dir():
        raise CheckpointUnavailable(
            f"'{url}' is not in openpi's cache at '{target}'; fetch it where there is a network, with openpi or with "
            f"`gsutil -m cp -r {url} {target.parent}/` (so that {target / 'params'} exists)."
        )
    return target


def find_tokenizer(checkpoint: Path, given: str | None) -> Path:
    """Return the sentencepiece model: the given one, else of the checkpoint, else of openpi's or the hub's cache."""
    if given is not None:
        return Path(given).expanduser()
    places = [
        checkpoint / "tokenizer" / "tokenizer.model",
        checkpoint / "tokenizer.model",
        checkpoint / TOKENIZER_NAME,
        openpi_cache() / TOKENIZER_URL.removeprefix("gs://"),
    ]
    cached = in_hub_cache(TOKENIZER_REPOSITORY, "tokenizer.model")
    places += [cached] if cached is not None else []
    for place in places:
        if place.is_file():
            return place
    snapshots = snapshots_folder(TOKENIZER_REPOSITORY)
    raise BadArgument(
        f"The checkpoint '{checkpoint}' needs PaliGemma's tokenizer and none was found at {listing(places)} or in "
        f"'{snapshots}'; fetch {TOKENIZER_NAME} ({TOKENIZER_URL}) or tokenizer.model of {TOKENIZER_REPOSITORY}, and "
        "give --tokenizer PATH."
    )
