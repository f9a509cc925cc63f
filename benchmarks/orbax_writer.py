"""Write a checkpoint in the layout of openpi's JAX format (orbax, OCDBT) with tensorstore, leaf by leaf.

The bytes differ from orbax's, the content is the same: `_METADATA` with the tree, and every leaf as a zarr array in one
OCDBT store. For benchmarks, and for tests of shapes and precisions that the golden checkpoints do not have.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
import tensorstore


def write_orbax(
    params: Path,
    shapes: Mapping[str, tuple[int, ...]],
    layer_of: Callable[[str, int], np.ndarray],
    *,
    dtype: str = "float32",
    value_suffix: bool = True,
    chunk_per_layer: bool = False,
) -> None:
    """Write a `params` folder.

    Args:
        params: the folder, which is made.
        shapes: JAX path joined by "/" -> shape of the leaf.
        layer_of: (path, index on the first axis) -> that part of the leaf. Called in order, one part at a time, so that
            a whole leaf is in memory only once.
        dtype: float32 or bfloat16, as stored.
        value_suffix: end every path with "value", as openpi's training does.
        chunk_per_layer: one chunk for each index of the first axis; otherwise one chunk for the leaf.
    """
    params.mkdir(parents=True)
    tree = {}
    for path, shape in shapes.items():
        names = ["params", *path.split("/"), *(["value"] if value_suffix else [])]
        tree[str(tuple(names))] = {
            "key_metadata": [{"key": name, "key_type": 2} for name in names],
            "value_metadata": {"value_type": "jax.Array", "skip_deserialize": False, "write_shape": list(shape)},
        }
        chunks = [1, *shape[1:]] if chunk_per_layer else list(shape)
        array = tensorstore.open(
            {
                "driver": "zarr",
                "kvstore": {"driver": "ocdbt", "base": f"file://{params.resolve()}/", "path": ".".join(names) + "/"},
                "metadata": {
                    "shape": list(shape),
                    "chunks": chunks,
                    "dtype": {"float32": "<f4", "bfloat16": "bfloat16"}[dtype],
                    "compressor": {"id": "zstd", "level": 1},
                },
                "store_data_equal_to_fill_value": True,
                "context": {"file_io_sync": False},
            },
            create=True,
        ).result()
        if chunk_per_layer:
            parts = (layer_of(path, i).astype(array.dtype.numpy_dtype) for i in range(shape[0]))
            for written in [array[i].write(part) for i, part in enumerate(parts)]:
                written.result()
        else:
            whole = np.empty(shape, dtype=array.dtype.numpy_dtype)
            for i in range(shape[0]):
                whole[i] = layer_of(path, i)
            array.write(whole).result()
    metadata = {"tree_metadata": tree, "use_zarr3": False, "store_array_data_equal_to_fill_value": True}
    (params / "_METADATA").write_text(json.dumps(metadata))


def write_leaves(params: Path, leaves: Mapping[str, np.ndarray], **options: object) -> None:
    """Write arrays in memory."""
    shapes = {path: tuple(leaf.shape) for path, leaf in leaves.items()}
    write_orbax(params, shapes, lambda path, i: leaves[path][i], **options)  # type: ignore[arg-type]
