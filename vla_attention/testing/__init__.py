"""Make small stores with known content, for tests of readers and recorders of your own. Imports no torch.

    from vla_attention.testing import StoreSpec, expected_arrays, write_store

    spec = StoreSpec(tasks=(0, 2), episodes=3)
    path = write_store(tmp_path / "a.zarr", spec=spec)
    expected_arrays(spec, task=2, episode=0)["joint/rows"]    # what your reader must find, to the bit

- `StoreSpec`, `write_store`: a store whose episodes have 39 keys (two cameras and a masked one, a prompt that changes,
  actions), or other tokens.
- `expected_arrays`, `root_attributes`: what the store must contain.
- `episode_records`: what a recorder gives to the writer, replan by replan (`vla_attention.capture.store.store_writer`).
- `small_tokens`, `libero_tokens`, `random_rows`: tokens of an episode, and attention-like rows for them.
- `rerun_source`: what a rerun of a store says of it (`StoreSpec.rerun_of`).
- `reseal`: seal an episode anew after changing its files, as a test of checks behind the seal needs;
  `reseal_root`: the digest in the root, too.
- `SiteStoreSpec`, `write_site_store`: stores of other policies: sites in some of the blocks, absent keys, generated
  tokens, unknown outcomes, a data set's actions.
- `assert_whole`: read a store back and fail on everything that `vla-attention verify` would report.
- `vla_attention.testing.strategies`: random layouts, tokens and groupings for hypothesis (to be installed beside it).
"""

from __future__ import annotations

from pathlib import Path

from vla_attention.schemas.stores.reader import open_store
from vla_attention.schemas.stores.verify import verify_store
from vla_attention.testing.site_stores import SiteStoreSpec, write_site_store
from vla_attention.testing.stores import (
    StoreSpec,
    episode_records,
    expected_arrays,
    rerun_source,
    reseal,
    reseal_root,
    root_attributes,
    write_store,
)
from vla_attention.testing.tokens import libero_tokens, random_rows, small_tokens

__all__ = [
    "SiteStoreSpec",
    "StoreSpec",
    "assert_whole",
    "episode_records",
    "expected_arrays",
    "libero_tokens",
    "random_rows",
    "rerun_source",
    "reseal",
    "reseal_root",
    "root_attributes",
    "small_tokens",
    "write_site_store",
    "write_store",
]


def assert_whole(path: Path) -> None:
    """Raise `AssertionError` with every fault of the store at `path`."""
    faults = verify_store(open_store(path))
    assert not faults, "; ".join(f"{fault.where}: {fault.problem}" for fault in faults)
