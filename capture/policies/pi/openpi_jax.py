"""Read openpi's JAX checkpoints (orbax, OCDBT) leaf by leaf with tensorstore; neither JAX nor orbax is needed.

A checkpoint folder holds `params/` with `_METADATA` (JSON: the tree) and an OCDBT key-value store, in which every leaf
is a zarr array under its path joined with ".". Stacked leaves are read layer by layer, largest leaves first, so that
memory never holds much more than the model itself.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from vla_attention.capture.policies.checkpoints import UnreadableCheckpoint, read_json_object
from vla_attention.capture.policies.pi.config import PiConfig
from vla_attention.capture.policies.pi.jax_weights import merge_lora, plan_leaves
from vla_attention.capture.policies.pi.model import PiModel, build_model, expected_shapes, expected_tensors
from vla_attention.capture.policies.pi.sizes import check_jax_heads
from vla_attention.capture.policies.weights import Shapes, check_floats, check_shapes
from vla_attention.schemas.checked_files import check_folder
from vla_attention.schemas.errors import MissingDependency
from vla_attention.schemas.hub import first_line
from vla_attention.schemas.install_line import install_line


@dataclass(frozen=True)
class Leaf:
    """One array of the checkpoint: its path in the model, and how tensorstore opens it."""

    path: str
    spec: Mapping[str, Any]


def list_leaves(params: Path) -> list[Leaf]:
    """Return the leaves of a `params` folder, with the names of `jax_weights`.

    The saved tree starts with "params", and runs of openpi's training end every path with "value"; both are removed.
    """
    metadata = read_json_object(params / "_METADATA")
    try:
        keys = [[str(part["key"]) for part in leaf["key_metadata"]] for leaf in metadata["tree_metadata"].values()]
        paths = [parts[1:] if parts[0] == "params" else parts for parts in keys]
    except (KeyError, TypeError, AttributeError, IndexError) as error:
        raise UnreadableCheckpoint(f"'{params / '_METADATA'}' does not describe a tree of arrays.") from error
    if all(path[-1:] == ["value"] for path in paths):
        paths = [path[:-1] for path in paths]
    base = f"file://{params.resolve()}/"
    spec = {
        "driver": "zarr3" if metadata.get("use_zarr3") else "zarr",
        # If the checkpoint declares that it stores every chunk, a missing chunk is an error, not zeros.
        "fill_missing_data_reads": not metadata.get("store_array_data_equal_to_fill_value"),
        "recheck_cached_data": False,
    }
    return [
        Leaf("/".join(path), {**spec, "kvstore": {"driver": "ocdbt", "base": base, "path": f"{'.'.join(parts)}/"}})
        for path, parts in zip(paths, keys, strict=True)
    ]


class OpenLeaf:
    """A leaf that is open for reading: its shape is known, its numbers are not in memory."""

    def __init__(self, params: Path, leaf: Leaf):
        self._what = f"The array '{leaf.path}' of '{params}' cannot be read: files are missing or damaged"
        self._spec = leaf.spec
        array = self._open(cache_bytes=0)
        self.shape: tuple[int, ...] = tuple(array.shape)
        self.size = math.prod(self.shape)
        chunk = tuple(array.chunk_layout.read_chunk.shape)
        # A chunk is decoded as a whole, however little of it is in the array.
        if any(extent > max(1, size) for extent, size in zip(chunk, self.shape, strict=True)):
            raise UnreadableCheckpoint(f"{self._what} (its chunks of {chunk} are larger than itself, {self.shape}).")
        check_floats({leaf.path: str(array.dtype.name)}, params)
        #: One chunk often holds all layers; it is kept while its layers are read one by one.
        bytes_of_layer = self.size * array.dtype.numpy_dtype.itemsize / max(1, *self.shape[:1])
        self._cache_bytes = int(1.1 * bytes_of_layer * chunk[0]) if chunk and chunk[0] > 1 else 0

    def read(self) -> np.ndarray:
        """Return the whole leaf as float32, with the axes of the JAX model."""
        return self._read(self._open(cache_bytes=0))

    def layers(self) -> Iterator[np.ndarray]:
        """Return the leaf as float32, one layer (first axis) after the other."""
        array = self._open(self._cache_bytes)
        for i in range(self.shape[0]):
            yield self._read(array[i])

    def _open(self, cache_bytes: int) -> Any:
        tensorstore = import_tensorstore()
        context = tensorstore.Context({"cache_pool": {"total_bytes_limit": cache_bytes}})
        try:
            return tensorstore.open(self._spec, open=True, read=True, context=context).result()
        except Exception as error:  # the library raises what the kind of the fault maps to, whatever it is
            raise UnreadableCheckpoint(f"{self._what} ({first_line(error)}).") from error

    def _read(self, array: Any) -> np.ndarray:
        try:
            return np.asarray(array.read().result()).astype(np.float32, copy=False)
        except Exception as error:  # as above
            raise UnreadableCheckpoint(f"{self._what} ({first_line(error)}).") from error


def import_tensorstore() -> Any:
    """Return the tensorstore module; `MissingDependency` without it."""
    try:
        import tensorstore
    except ImportError as error:
        raise MissingDependency(
            "Checkpoints in openpi's JAX format are read with tensorstore, which is not installed; "
            f"install it with `{install_line('openpi')}`."
        ) from error
    return tensorstore


def load_openpi_jax(folder: Path, config: PiConfig, dtype: torch.dtype, device: str | torch.device) -> PiModel:
    """Load a checkpoint in openpi's JAX format.

    Such a checkpoint does not state its configuration. All shapes are checked against the given one; the action horizon
    is in none of them. LoRA arrays are merged into the weights that they adapt.
    """
    params = folder / "params"
    leaves = list_leaves(params)
    plans, pairs = plan_leaves(leaf.path for leaf in leaves)
    check_folder(params, UnreadableCheckpoint)  # the library opens the files by itself
    stored = {leaf.path: OpenLeaf(params, leaf) for leaf in leaves}
    shapes: Shapes = {}
    for path, plan in plans.items():
        try:
            shapes |= plan.shapes(stored[path].shape)
        except (ValueError, IndexError):
            # An array with another number of axes than its conversion expects is reported by its JAX name.
            shapes[path] = stored[path].shape
    check_shapes(shapes, expected_shapes(config))
    check_jax_heads({path: leaf.shape for path, leaf in stored.items()}, config)

    kept_as = expected_tensors(config, dtype)
    state: dict[str, Tensor] = {}

    def keep(arrays: dict[str, np.ndarray]) -> None:
        for name, array in arrays.items():
            tensor = torch.from_numpy(np.ascontiguousarray(array))  # copies transposed tensors only
            # openpi's server restores every parameter as bfloat16, also those that it then uses in float32.
            state[name] = tensor.to(dtype).to(device=device, dtype=kept_as[name].dtype)

    # The largest first: reading one takes extra memory, and little of the model is in memory then.
    for path in sorted(plans, key=lambda path: stored[path].size, reverse=True):
        plan = plans[path]
        if not plan.is_stacked:
            keep(plan.layer(None, stored[path].read()))
            continue
        factors = (stored[factor].layers() for factor in pairs.get(path, ()))
        for i, (w, *ab) in enumerate(zip(stored[path].layers(), *factors, strict=True)):
            keep(plan.layer(i, merge_lora(path, w, *ab) if ab else w))
    return build_model(config, state, state.__getitem__, dtype=dtype, device=device)
