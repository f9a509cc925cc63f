"""Masses and rows as labelled arrays (xarray), and as NetCDF files.

Episodes have different lengths. Therefore (episode, replan) is one axis, `sample`, with coordinates that say which
episode and which environment step each sample is; nothing is padded. Heads are always kept apart; stored queries are
averaged.

    mass       (sample, layer, denoise, head, group)   sum of probability x weight
    row_sum    (sample, layer, denoise, head)          sum of the row, before storage rounded it
    num_keys   (sample, group), num_valid (sample)     keys of the group; keys that can hold information
    uniform_mass   as mass: what uniform attention gives; uniform_valid as row_sum: what it gives all valid keys
    rows       (sample, layer, denoise, head, key)     only on request: the probabilities themselves
    key_role   (sample, key)                           with rows: codes of `vla_attention.schemas.layout.Role`
    effect_change (entry, step, dimension) ...         where effects were recorded: `recorded_effects.effect_arrays`

xarray and h5netcdf are the extra `xarray`; nothing here imports them before an array is asked for.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from vla_attention.analyze.export.recorded_effects import effect_arrays
from vla_attention.analyze.export.refusing_disk import untold_file
from vla_attention.analyze.measures.question import Question
from vla_attention.analyze.measures.steps import measure_episodes
from vla_attention.analyze.show.output_files import replacing, writing
from vla_attention.analyze.stores.rows import layer_rows
from vla_attention.schemas.command_line import format_bytes
from vla_attention.schemas.errors import BadArgument, MissingDependency
from vla_attention.schemas.layout import Role, SiteLayout
from vla_attention.schemas.precision import mass_error_bound
from vla_attention.schemas.safe_text import visible

if TYPE_CHECKING:
    import xarray

ROW_DIMENSIONS = ("sample", "layer", "denoise", "head", "key")
_MASS_DIMENSIONS = (*ROW_DIMENSIONS[:-1], "group")
#: Rows are stored in pieces of about this size, each of whole (head, key) planes of one layer and denoise step.
_CHUNK_BYTES = 1 << 18


@dataclass(frozen=True)
class RowsSize:
    """The size of the rows of a question: lengths of the axes, and bytes in float32 before compression."""

    shape: tuple[int, int, int, int, int]

    @property
    def num_bytes(self) -> int:
        """Bytes in float32, uncompressed."""
        return 4 * int(np.prod([int(length) for length in self.shape], dtype=object))

    def __str__(self) -> str:
        samples, layers, steps, heads, keys = self.shape
        return (
            f"{samples} samples x {layers} layers x {steps} denoise steps x {heads} heads x {keys} keys, "
            f"{format_bytes(self.num_bytes)} in float32"
        )


def rows_size(question: Question) -> RowsSize:
    """The size of a question's rows, before any is read."""
    selection = question.selection
    samples = sum(item.episode.attributes.num_replans for item in question.selected)
    keys = question.selected[0].tokens.layout.num_keys
    return RowsSize((samples, len(selection.layers), len(selection.denoise), len(selection.heads), keys))


def masses_array(question: Question, progress: Callable[[int], object] | None = None) -> xarray.Dataset:
    """The masses of a question's groups; `progress` is called with 1 after each episode.

    Raises:
        MissingDependency: xarray is not installed.
    """
    xr = _needed("xarray")
    measured = measure_episodes(question, progress=progress, per_head=True)
    mass = np.concatenate([one.mass for one in measured])
    row_sum = np.concatenate([one.row_sum for one in measured])
    keys = np.concatenate([np.broadcast_to(one.num_keys, (len(one.mass), one.num_keys.shape[1])) for one in measured])
    valid = np.concatenate([np.broadcast_to(one.num_valid, len(one.mass)) for one in measured])
    uniform, of_valid = (
        np.concatenate([np.broadcast_to(getattr(one, name), getattr(one, like).shape) for one in measured])
        for name, like in (("uniform_mass", "mass"), ("uniform_valid", "valid_mass"))
    )
    cells = _MASS_DIMENSIONS[:-1]
    dataset: xarray.Dataset = xr.Dataset(
        {
            "mass": (_MASS_DIMENSIONS, mass, {"long_name": "attention mass", "units": "1"}),
            "row_sum": (cells, row_sum, {"long_name": "sum of the row as computed", "units": "1"}),
            "num_keys": (
                ("sample", "group"), keys, {"long_name": "number of keys, fractional for objects"}
            ),
            "num_valid": ("sample", valid, {"long_name": "number of valid keys"}),
            "uniform_mass": (_MASS_DIMENSIONS, uniform, {"long_name": "mass that uniform attention gives"}),
            "uniform_valid": (cells, of_valid, {"long_name": "mass that uniform attention gives all valid keys"}),
        },
        coords={**_sample_coordinates(question), **_axis_coordinates(question), "group": list(question.grouping.names)},
        attrs=_attributes(question),
    )  # fmt: skip
    return dataset


def rows_array(
    question: Question, most_bytes: int | None = None, progress: Callable[[int], object] | None = None
) -> xarray.Dataset:
    """The rows of a question in memory, with the roles of their keys.

    Raises:
        BadArgument: they would take more than `most_bytes`.
        MissingDependency: xarray is not installed.
    """
    xr = _needed("xarray")
    size = rows_size(question)
    if most_bytes is not None and size.num_bytes > most_bytes:
        raise BadArgument(
            f"The rows would take {size}, more than the {format_bytes(most_bytes)} that are allowed; choose fewer "
            "layers, denoise steps, heads or tasks, allow more, or write them to a file with vla-attention export "
            "--netcdf --rows."
        )
    rows = np.empty(size.shape, dtype=np.float32)
    for part, values in _parts(question, progress):
        rows[part] = values
    variables = {
        name: (dimensions, values, attributes) for name, dimensions, values, attributes in _key_variables(question)
    }
    dataset: xarray.Dataset = xr.Dataset(
        {"rows": (ROW_DIMENSIONS, rows, _rows_attributes(question))},
        coords={**_sample_coordinates(question), **_axis_coordinates(question), **variables},
        attrs=_attributes(question),
    )
    return dataset


def write_netcdf(
    question: Question, path: Path, rows: bool = False, progress: Callable[[int], object] | None = None
) -> Path:
    """Write masses and, if asked for, rows into one NetCDF-4 file, which appears whole. Rows are never held at once.

    `progress` is called with 1 after each episode, once for masses and once for rows.

    Raises:
        MissingDependency: xarray or h5netcdf is not installed.
        BadArgument: the file cannot be written.
    """
    h5netcdf = _needed("h5netcdf")
    _needed("h5py")
    masses = masses_array(question, progress).assign(effect_arrays(question))
    compressed = {name: {"zlib": True, "complevel": 4} for name in ("mass", "row_sum", "uniform_mass", "uniform_valid")}
    with writing("the arrays", path), replacing(path) as temporary, untold_file(temporary) as untold:

        def advance(episodes: int) -> None:
            untold.check()
            if progress is not None:
                progress(episodes)

        masses.to_netcdf(untold, engine="h5netcdf", encoding=compressed)
        untold.check()
        if rows:
            with h5netcdf.File(untold, "a") as file:
                _write_rows(file, question, advance)
    return path


def _write_rows(file: Any, question: Question, progress: Callable[[int], object] | None) -> None:
    size = rows_size(question)
    samples, _, _, heads, keys = size.shape
    file.dimensions["key"] = keys
    for name, dimensions, values, attributes in _key_variables(question):
        kind = values.dtype if values.dtype.kind != "U" else _needed("h5py").string_dtype()
        variable = file.create_variable(name, dimensions, kind)
        variable[...] = values if values.dtype.kind != "U" else values.astype(object)
        for key, value in attributes.items():
            variable.attrs[key] = value
    chunk = (max(1, min(samples, _CHUNK_BYTES // (4 * heads * keys))), 1, 1, heads, keys)
    variable = file.create_variable(
        "rows", ROW_DIMENSIONS, np.float32, chunks=chunk, compression="gzip", compression_opts=4, shuffle=True
    )
    for key, value in _rows_attributes(question).items():
        variable.attrs[key] = value
    # From this attribute xarray reads which variables describe axes.
    about_keys = [name for name, *_ in _key_variables(question)]
    variable.attrs["coordinates"] = " ".join([*_SAMPLE_COORDINATES, "block", "denoise_time", *about_keys])
    for part, values in _parts(question, progress):
        variable[part] = values


def _parts(question: Question, progress: Callable[[int], object] | None) -> Any:
    """(index, values): where a piece of rows (replan, head, key) belongs, for every episode, layer and denoise step."""
    start = 0
    for item in question.selected:
        stop = start + item.episode.attributes.num_replans
        for part in layer_rows(item.store.attributes, item.episode, question.selection, question.site, per_head=True):
            yield (slice(start, stop), part.layer, part.denoise), part.rows
        start = stop
        if progress is not None:
            progress(1)


_SAMPLE_COORDINATES = (
    "suite", "store", "task_id", "instruction", "episode_index", "success", "num_steps", "replan", "env_step",
)  # fmt: skip


def _sample_coordinates(question: Question) -> dict[str, tuple[str, NDArray[Any]]]:
    """Episode and environment step of every sample."""
    columns: dict[str, list[Any]] = {name: [] for name in _SAMPLE_COORDINATES}
    for item in question.selected:
        attributes = item.episode.attributes
        constant = {
            "suite": item.store.suite,
            "store": item.store.path.name,
            **{name: getattr(attributes, name) for name in ("task_id", "episode_index", "success", "num_steps")},
            "instruction": visible(attributes.instruction),
        }
        for name, value in constant.items():
            columns[name] += [value] * attributes.num_replans
        columns["replan"] += range(attributes.num_replans)
        columns["env_step"] += item.episode.read("env_step").tolist()
    if None in columns["success"]:  # no array of numbers has a place for what is not known
        columns["success"] = [np.nan if value is None else float(value) for value in columns["success"]]
    return {name: ("sample", np.array(values)) for name, values in columns.items()}


def _axis_coordinates(question: Question) -> dict[str, Any]:
    selection = question.selection
    times = [item.episode.read("denoise_time")[list(selection.denoise)] for item in question.selected]
    counts = [item.episode.attributes.num_replans for item in question.selected]
    same = all(np.array_equal(times[0], other) for other in times)
    return {
        "layer": ("layer", np.array(selection.layer_labels), {"long_name": "layer, as the user numbers it"}),
        "block": ("layer", np.array(selection.blocks), {"long_name": "transformer block"}),
        "denoise": ("denoise", np.array(selection.denoise_steps), {"long_name": "denoise step"}),
        "denoise_time": ("denoise", times[0]) if same else (("sample", "denoise"), np.repeat(times, counts, axis=0)),
        "head": ("head", np.array(selection.head_numbers)),
    }


def _key_variables(question: Question) -> list[tuple[str, tuple[str, ...], NDArray[Any], Mapping[str, Any]]]:
    """Name, dimensions, values and attributes of the variables that describe keys."""
    layout = question.selected[0].tokens.layout
    codes = {"flag_values": np.array([int(role) for role in Role], dtype=np.uint8)}
    roles = []
    for item in question.selected:
        stored = item.tokens.key_role
        roles.append(np.broadcast_to(stored, (item.episode.attributes.num_replans, stored.shape[1])))
    meanings = {**codes, "flag_meanings": " ".join(role.label for role in Role)}
    return [
        ("key_span", ("key",), _of_span(layout, [span.name for span in layout.spans]), {}),
        ("key_kind", ("key",), _of_span(layout, [span.kind for span in layout.spans]), {}),
        ("key_camera", ("key",), _of_span(layout, [span.camera or "" for span in layout.spans]), {}),
        *_patches(layout),
        ("key_role", ("sample", "key"), np.concatenate(roles), meanings),
    ]


def _of_span(layout: SiteLayout, names: list[str]) -> NDArray[np.str_]:
    return np.array(names)[layout.span_of_key()]


def _patches(layout: SiteLayout) -> list[tuple[str, tuple[str, ...], NDArray[Any], Mapping[str, Any]]]:
    """Row and column of every patch, from the top left; -1 for keys that are no patch."""
    rows, columns = (np.full(layout.num_keys, -1, dtype=np.int32) for _ in range(2))
    for span in layout.spans:
        if span.grid is not None:
            patch = np.arange(span.num_keys)
            rows[span.start : span.stop] = patch // span.grid.columns
            columns[span.start : span.stop] = patch % span.grid.columns
    note = {"comment": "from the top left; -1: no patch"}
    return [("patch_row", ("key",), rows, note), ("patch_column", ("key",), columns, note)]


def _rows_attributes(question: Question) -> dict[str, Any]:
    bits = question.stores[0].attributes.recording.mantissa_bits
    return {
        "long_name": "attention probability, mean over the stored queries",
        "units": "1",
        "relative_error": mass_error_bound(bits),
    }


def _attributes(question: Question) -> dict[str, Any]:
    """Attributes of the dataset: text and numbers only, because not every format holds more."""
    root, grouping = question.stores[0].attributes, question.grouping
    attributes: dict[str, Any] = {
        "title": f"attention of the action queries, site '{question.site}'",
        "site": question.site,
        "stores": [str(store.path) for store in question.stores],
        "policy": root.policy.name,
        "checkpoint": root.policy.checkpoint,
        "policy_digest": root.policy.digest,
        "untrained": int(root.policy.untrained),
        "queries": root.recording.queries,
        "mantissa_bits": root.recording.mantissa_bits,
        "grouping": grouping.name,
        "groups": json.dumps({name: list(selectors) for name, selectors in grouping.groups.items()}),
    }
    if grouping.ratio is not None:
        sides = (grouping.ratio.numerator, grouping.ratio.denominator)
        attributes["ratio"] = " / ".join("+".join(side) for side in sides)
    return attributes


def _needed(module: str) -> Any:
    try:
        return import_module(module)
    except ImportError:
        raise MissingDependency(
            f"Labelled arrays and NetCDF need {module}, which is not installed; pip install 'vla-attention[xarray]'."
        ) from None
