"""Read openpi's JAX checkpoints (orbax, OCDBT) leaf by leaf with tensorstore; neither JAX nor orbax is needed.

A checkpoint folder holds `params/` with `_METADATA` (JSON: the tree) and an OCDBT key-value store, in which every leaf is a
zarr array under its path joined with ".".
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from capture.policies.pi.checkpoint import UnreadableCheckpoint, UnsupportedCheckpoint, detect_format
from capture.policies.pi.config import PiConfig, find_config
from capture.policies.pi.jax_weights import find_converters
from capture.policies.pi.model import PiModel
from capture.policies.pi.strict import build_model, check_shapes, expected_shapes, expected_tensors
from schemas.errors import MissingDependency


@dataclass(frozen=True)
class Leaf:
    """One array of the checkpoint: its path in the model, its key in the store, and how it is stored."""

    path: str
    store_key: str
    driver: str
    all_chunks_stored: bool


def list_leaves(params: Path) -> list[Leaf]:
    """Return the leaves of a `params` folder, by the names that `jax_weights` knows.

    The saved tree starts with "params", and runs of openpi's training end every path with "value"; both are taken off.
    """
    metadata = _read_metadata(params / "_METADATA")
    driver = "zarr3" if metadata.get("use_zarr3") else "zarr"
    complete = bool(metadata.get("store_array_data_equal_to_fill_value"))
    try:
        keys = [[part["key"] for part in leaf["key_metadata"]] for leaf in metadata["tree_metadata"].values()]
        stored = [".".join(parts) for parts in keys]
    except (KeyError, TypeError, AttributeError) as error:
        raise UnreadableCheckpoint(f"'{params / '_METADATA'}' does not describe a tree of arrays.") from error
    paths = [parts[1:] if parts[0] == "params" else parts for parts in keys]
    if all(path[-1] == "value" for path in paths):
        paths = [path[:-1] for path in paths]
    return [Leaf("/".join(path), store_key, driver, complete) for path, store_key in zip(paths, stored, strict=True)]


def _read_metadata(path: Path) -> dict[str, Any]:
    try:
        metadata = json.loads(path.read_text(encoding="utf-8"))
    except ValueError as error:
        raise UnreadableCheckpoint(f"'{path}' is not valid JSON ({error}).") from error
    if not isinstance(metadata, dict) or not metadata.get("tree_metadata"):
        raise UnreadableCheckpoint(f"'{path}' does not describe a tree of arrays.")
    return metadata


def read_leaf(params: Path, leaf: Leaf) -> np.ndarray:
    """Read one leaf as float32, with the axes of the JAX model.

    Where the checkpoint says that it stores every chunk, a chunk that is not there is an error and not zeros.
    """
    try:
        import tensorstore
    except ImportError as error:
        raise MissingDependency(
            "Checkpoints in openpi's JAX format are read with tensorstore, which is not installed; "
            "install it with `pip install tensorstore`."
        ) from error
    spec = {
        "driver": leaf.driver,
        "kvstore": {
            "driver": "ocdbt",
            "base": f"file://{params.resolve()}/",
            "path": f"{leaf.store_key}/",
        },
        "fill_missing_data_reads": not leaf.all_chunks_stored,
    }
    try:
        array = tensorstore.open(spec, open=True, read=True).result().read().result()
    except (ValueError, OSError) as error:
        raise UnreadableCheckpoint(
            f"The array '{leaf.path}' of '{params}' cannot be read: files are missing or damaged "
            f"({str(error).splitlines()[0]})."
        ) from error
    return np.asarray(array).astype(np.float32, copy=False)


def load_openpi_jax(
    folder: str | Path,
    *,
    config: PiConfig | None = None,
    dtype: torch.dtype = torch.float32,
    device: str | torch.device = "cpu",
) -> PiModel:
    """Load a checkpoint in openpi's JAX format.

    Such a checkpoint does not say which configuration it was trained with. Without `config` it is openpi's pi05_libero, or
    pi0_libero when it has a state projection; all shapes are checked against it, but the action horizon shows in none.
    """
    folder = Path(folder)
    if detect_format(folder) != "openpi_jax":
        raise UnsupportedCheckpoint(f"'{folder}' is not a checkpoint in openpi's JAX (orbax) format.")
    params = folder / "params"
    leaves = list_leaves(params)
    if config is None:
        config = find_config(
            "pi0_libero" if any(leaf.path.startswith("state_proj/") for leaf in leaves) else "pi05_libero"
        )
    kept_as = expected_tensors(config, dtype)
    converters = find_converters(leaf.path for leaf in leaves)
    state: dict[str, Tensor] = {}
    for leaf in leaves:
        for name, array in converters[leaf.path](read_leaf(params, leaf)).items():
            # Cast at once: all of it in float32 beside the model being built would be twice the memory.
            target = kept_as[name].dtype if name in kept_as else dtype
            state[name] = torch.from_numpy(np.array(array, order="C")).to(target)
    check_shapes({name: tuple(tensor.shape) for name, tensor in state.items()}, expected_shapes(config))
    return build_model(config, state, state.__getitem__, dtype=dtype, device=device)
