"""Find a checkpoint's files: in its folder, beside it, in the Hugging Face hub's cache, or through the hub's client."""

from __future__ import annotations

import os
from pathlib import Path

from vla_attention.capture.policies.checkpoints import (
    CheckpointNotFound,
    UnreadableCheckpoint,
    UnsupportedCheckpoint,
    check_checkpoint_file,
)
from vla_attention.schemas.checked_files import check_regular
from vla_attention.schemas.errors import BadArgument, listing
from vla_attention.schemas.hub import in_hub_cache, local_or_fetched

POLICY_REPOSITORY = "nvidia/Cosmos-Policy-LIBERO-Predict2-2B"
#: Repository of the image encoder, which the policy's own repository does not contain.
VAE_REPOSITORY = "nvidia/Cosmos-Predict2-2B-Video2World"
VAE_NAME = "tokenizer/tokenizer.pth"
STATISTICS_NAME = "libero_dataset_statistics.json"
EMBEDDINGS_NAME = "libero_t5_embeddings.pkl"
#: T5's vocabulary is the same in all sizes.
T5_REPOSITORIES = ("google-t5/t5-11b", "google-t5/t5-small", "google-t5/t5-base", "google-t5/t5-large")
T5_TOKENIZER = "spiece.model"


def find_checkpoint(name: str) -> Path:
    """Return the folder (or the file of weights) that `--ckpt-path` names.

    It is a local path, or `ORG/NAME` or `ORG/NAME@COMMIT` of the hub. Files that are not in the hub's cache
    are downloaded; `CheckpointUnavailable` if that fails.
    """
    found = local_or_fetched(name, ["*.pt", STATISTICS_NAME, EMBEDDINGS_NAME])
    if found is None:
        raise CheckpointNotFound(
            f"There is no checkpoint at '{Path(name).expanduser()}'; give a folder with a .pt file, {STATISTICS_NAME} "
            f"and {EMBEDDINGS_NAME}, or {POLICY_REPOSITORY}."
        )
    return found


def find_weights(checkpoint: Path) -> Path:
    """Return the transformer's file of a checkpoint folder: the one `.pt` file in it."""
    if not checkpoint.is_dir():
        check_regular(checkpoint, UnreadableCheckpoint)
        return checkpoint
    if (checkpoint / "model").is_dir():
        raise UnsupportedCheckpoint(
            f"'{checkpoint}' has its weights in the distributed form (folder 'model'), which the reference would read "
            "first and which is not read here; convert it to one .pt file, and give that file as --ckpt-path."
        )
    files = sorted([*checkpoint.glob("*.pt"), *checkpoint.glob("*.safetensors")])
    if len(files) != 1:
        inside = listing(sorted(path.name for path in checkpoint.iterdir()))
        what = "no .pt file" if not files else f"several files of weights ({listing(path.name for path in files)})"
        raise CheckpointNotFound(
            f"The checkpoint '{checkpoint}' has {what}; expected one, and found {inside}."
            + (" Give one of them as --ckpt-path." if files else "")
        )
    check_checkpoint_file(files[0])
    return files[0]


def find_vae(checkpoint: Path, given: str | None, *, from_hub: bool = False) -> Path:
    """Return the image encoder's file: the given one, else in or beside the checkpoint, else from the hub."""
    folder = checkpoint if checkpoint.is_dir() else checkpoint.parent
    if given is not None:
        named = Path(given).expanduser()
        places = [named / VAE_NAME, named / Path(VAE_NAME).name] if named.is_dir() else [named]
    else:
        beside = folder.absolute().parent / VAE_REPOSITORY.split("/")[1]
        places = [folder / VAE_NAME, folder / Path(VAE_NAME).name, beside / VAE_NAME]
        cached = in_hub_cache(VAE_REPOSITORY, VAE_NAME)
        places += [cached] if cached is not None else []
    for place in places:
        if place.is_file():
            return place
    fetched = local_or_fetched(VAE_REPOSITORY, [VAE_NAME]) if from_hub and given is None else None
    if fetched is not None:
        return fetched / VAE_NAME
    raise CheckpointNotFound(
        f"The image encoder was not found at {listing(places)}; it is published separately from the policy: fetch it "
        f"with `hf download {VAE_REPOSITORY} {VAE_NAME}` and give --vae-path."
    )


def find_beside(checkpoint: Path, given: str | None, name: str) -> Path:
    """Return a file of the checkpoint's folder, or the given one: a path, or ORG/NAME/FILE in the hub's cache."""
    folder = checkpoint if checkpoint.is_dir() else checkpoint.parent
    if given is None:
        if os.path.lexists(folder / name):
            check_checkpoint_file(folder / name)
        return folder / name
    path = Path(given).expanduser()
    if path.exists() or given.count("/") != 2:
        return path
    repository, _, file = given.rpartition("/")
    cached = in_hub_cache(repository, file)
    return cached if cached is not None else path


def find_t5_tokenizer(checkpoint: Path, given: str | None) -> Path | None:
    """Return T5's sentencepiece model: the given one, else of the checkpoint or the hub's cache; None if not found."""
    if given is not None:
        path = Path(given).expanduser()
        if path.is_dir():
            path = path / T5_TOKENIZER
        if not path.is_file():
            raise BadArgument(f"There is no T5 tokenizer at '{path}'; expected {T5_TOKENIZER} of {T5_REPOSITORIES[0]}.")
        return path
    folder = checkpoint if checkpoint.is_dir() else checkpoint.parent
    if (folder / T5_TOKENIZER).is_file():
        return folder / T5_TOKENIZER
    return next((cached for name in T5_REPOSITORIES if (cached := in_hub_cache(name, T5_TOKENIZER))), None)
