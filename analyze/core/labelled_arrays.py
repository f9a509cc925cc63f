"""Masses and rows as labelled arrays (xarray).

Episodes have different lengths. Therefore (episode, replan) is one axis, `sample`, with coordinates that say which
episode and which environment step each sample is; nothing is padded. Heads are always kept apart; stored queries are
averaged.

    mass       (sample, layer, denoise, head, group)   sum of probability x weight
    row_sum    (sample, layer, denoise, head)          sum of the row, before storage rounded it
    num_keys   (sample, group), num_valid (sample)     keys of the group; keys that can hold information
    uniform_mass   as mass: what uniform attention gives; uniform_valid as row_sum: what it gives all valid keys
    rows       (sample, layer, denoise, head, key)     the probabilities themselves, of one episode at a time
    key_role   (sample, key)                           with rows: codes of `vla_attention.schemas.layout.Role`

xarray is the extra `xarray`; nothing here imports it before an array is asked for.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from dataclasses import replace
from importlib import import_module
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from vla_attention.analyze.core.levels import levels_of
from vla_attention.analyze.measures.question import Question
from vla_attention.analyze.stores.rows import layer_rows
from vla_attention.schemas.errors import MissingDependency
from vla_attention.schemas.layout import Role, SiteLayout
from vla_attention.schemas.precision import mass_error_bound
from vla_attention.schemas.safe_text import visible

if TYPE_CHECKING:
    import xarray

ROW_DIMENSIONS = ("sample", "layer", "denoise", "head", "key")
_MASS_DIMENSIONS = (*ROW_DIMENSIONS[:-1], "group")


def masses_array(question: Question) -> xarray.Dataset:
    """The masses of a question's groups.

    Raises:
        MissingDependency: xarray is not installed.
    """
    xr = _needed("xarray")
    measured, groups = levels_of(question, heads=True).measured, slice(len(question.grouping.names))

    def joined(name: str, like: str = "") -> NDArray[Any]:
        arrays = [(getattr(one, name), one) for one in measured]
        if name in ("mass", "uniform", "keys"):
            arrays = [(array[..., groups], one) for array, one in arrays]
        if like:
            shape = slice(None) if like == "valid" else groups
            arrays = [(np.broadcast_to(array, getattr(one, like)[..., shape].shape), one) for array, one in arrays]
        else:
            arrays = [(np.broadcast_to(array, (len(one.env_step), *array.shape[1:])), one) for array, one in arrays]
        return np.concatenate([array for array, _ in arrays])

    cells = _MASS_DIMENSIONS[:-1]
    dataset: xarray.Dataset = xr.Dataset(
        {
            "mass": (_MASS_DIMENSIONS, joined("mass"), {"long_name": "attention mass", "units": "1"}),
            "row_sum": (cells, joined("row_sum"), {"long_name": "sum of the row as computed", "units": "1"}),
            "num_keys": (
                ("sample", "group"), joined("keys"), {"long_name": "number of keys, fractional for objects"}
            ),
            "num_valid": ("sample", joined("num_valid"), {"long_name": "number of valid keys"}),
            "uniform_mass": (
                _MASS_DIMENSIONS, joined("uniform", "mass"), {"long_name": "mass that uniform attention gives"}
            ),
            "uniform_valid": (
                cells, joined("uniform_valid", "valid"), {"long_name": "what uniform attention gives all valid keys"}
            ),
        },
        coords={**_sample_coordinates(question), **_axis_coordinates(question), "group": list(question.grouping.names)},
        attrs=_attributes(question),
    )  # fmt: skip
    return dataset


def rows_of_episodes(question: Question) -> Iterator[xarray.Dataset]:
    """The rows of one episode after the other, with the roles of their keys: those of all would fill the memory.

    Raises:
        MissingDependency: xarray is not installed.
    """
    xr = _needed("xarray")
    for item in question.selected:
        one, selection = replace(question, selected=(item,)), question.selection
        shape = (item.tokens.num_replans, len(selection.layers), len(selection.denoise), len(selection.heads))
        rows = np.empty((*shape, item.tokens.layout.num_keys), dtype=np.float32)
        for part in layer_rows(item.store.attributes, item.episode, selection, question.site, per_head=True):
            rows[:, part.layer, part.denoise] = part.rows
        of_keys = {name: (dimensions, values, about) for name, dimensions, values, about in _key_variables(one)}
        yield xr.Dataset(
            {"rows": (ROW_DIMENSIONS, rows, _rows_attributes(question))},
            coords={**_sample_coordinates(one), **_axis_coordinates(one), **of_keys},
            attrs=_attributes(question),
        )


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
            f"Labelled arrays need {module}, which is not installed; pip install 'vla-attention[xarray]'."
        ) from None
