"""What every command that records is asked: what is recorded, and where the store goes. Imports nothing heavy."""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from vla_attention.capture.effects.arguments import EffectSettings, effect_settings
from vla_attention.schemas.options import option, read_options
from vla_attention.schemas.precision import DEFAULT_MANTISSA_BITS, parse_precision

if TYPE_CHECKING:
    from vla_attention.capture.store.store_writer import WriteMode


@dataclass(frozen=True)
class RecordingSettings:
    """What is recorded of each policy call; None means everything."""

    layers: tuple[int, ...] | None = option("block indices (default: all)", None, group="what is recorded")
    denoise_steps: tuple[int | str, ...] = option(
        "numbers, first, last or all (default: first last)", ("first", "last"), name="denoise", metavar="STEP"
    )
    heads: tuple[int, ...] | None = option("attention heads (default: all)", None)
    queries: Literal["mean", "steps", "all"] = option(
        "mean over the action queries, steps (one mean per action step), or all (default: mean)", "mean"
    )
    mantissa_bits: int = option(
        "mantissa bits kept of each probability, or 'exact' (default: %(default)s, which bounds the error of every "
        "ratio by 0.2 %%)",
        DEFAULT_MANTISSA_BITS,
        name="precision",
        type=str,
        metavar="BITS",
    )
    contributions: bool = option(
        "also record what each part of the tokens adds to the residual stream, value-weighted (default: yes)", True
    )
    frames: bool = option("also store the model's input images (default: yes)", True)
    effects: EffectSettings | None = None


def recording_settings(given: argparse.Namespace) -> RecordingSettings:
    """Return what parsed arguments say, effects included."""
    bits = parse_precision(str(given.precision))
    return read_options(RecordingSettings, given, mantissa_bits=bits, effects=effect_settings(given))


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
        from vla_attention.schemas.stores.store_place import check_place

        store = self.store or (self.output_dir or Path("runs")) / f"{name}.zarr"
        check_place(store, "write a store at")
        return store
