"""Where the store of a run goes, and what happens to one that is there. Every `--help` imports this, nothing heavy."""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vla_attention.schemas.options import option
from vla_attention.schemas.stores.store_place import check_place

if TYPE_CHECKING:
    from vla_attention.capture.store.store_writer import WriteMode


class _StoreOrFolder(argparse.Action):
    """`--output` of a capture: `NAME.zarr` is the store, anything else a folder."""

    def __call__(self, parser: Any, namespace: Any, values: Any, option_string: str | None = None) -> None:
        """Keep the path as `store` or as `output_dir`."""
        setattr(namespace, "store" if values.suffix == ".zarr" else "output_dir", values)


@dataclass(frozen=True)
class StoreOutput:
    """Where the store goes; the published scripts call `--output` of a folder `--output-dir`."""

    store: Path | None = option(
        "the store, NAME.zarr, or a folder for it",
        None,
        group="output",
        name="output",
        dest="store",
        action=_StoreOrFolder,
    )
    output_dir: Path | None = option(argparse.SUPPRESS, None)
    resume: bool = option("continue an existing store with what is missing", False, either="existing")
    overwrite: bool = option("delete an existing store first", False, either="existing")

    @property
    def mode(self) -> WriteMode:
        """What happens to a store that is there."""
        return "overwrite" if self.overwrite else "resume" if self.resume else "new"

    def place(self, name: str) -> Path:
        """Return the path of the store: as given, else that name in the folder, or in `runs`."""
        store = self.store or (self.output_dir or Path("runs")) / f"{name}.zarr"
        check_place(store, "write a store at")
        return store
