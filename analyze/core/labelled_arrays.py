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
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from vla_attention.analyze.core.levels import levels_of
from vla_attention.analyze.measures.question import Question
from vla_attention.analyze.measures.selected import SelectedEpisode
from vla_attention.analyze.stores.rows import layer_rows
from vla_attention.analyze.stores.selection import Selection
from vla_attention.schemas.errors import MissingDependency
from vla_attention.schemas.install_line import install_line
from vla_attention.schemas.layout import Role
from vla_attention.schemas.precision import key_error_bound, mass_error_bound
from vla_attention.schemas.safe_text import visible

if TYPE_CHECKING:
    import xarray

ROW_DIMENSIONS = ("sample", "layer", "denoise", "head", "key")
_CELL = ROW_DIMENSIONS[:-1]


def masses_array(question: Question) -> xarray.Dataset:
    """The masses of a question's groups.

    Raises:
        MissingDependency: xarray is not installed.
    """
    xr, names = _xarray(), list(question.grouping.names)
    of_groups = {
        "mass": {"long_name": "attention mass", "units": "1"},
        "uniform_mass": {"long_name": "mass that uniform attention gives"},
    }
    of_cells = {
        "row_sum": {"long_name": "sum of the row as computed", "units": "1"},
        "uniform_valid": {"long_name": "what uniform attention gives all valid keys"},
    }
    known = all(item.episode.attributes.success is not None for item in question.selected)
    parts = []
    for one in levels_of(question, heads=True).measured:
        arrays = {"mass": one.mass, "uniform_mass": one.uniform, "row_sum": one.row_sum,
                  "uniform_valid": one.uniform_valid}  # fmt: skip
        replans = len(one.env_step)
        variables: dict[str, Any] = {
            name: ((*_CELL, "group"), np.broadcast_to(arrays[name], one.mass.shape)[..., : len(names)], about)
            for name, about in of_groups.items()
        }
        variables |= {
            name: (_CELL, np.broadcast_to(arrays[name], one.valid.shape), about) for name, about in of_cells.items()
        }
        keys = np.broadcast_to(one.keys, (replans, one.keys.shape[1]))[:, : len(names)]
        variables["num_keys"] = (("sample", "group"), keys, {"long_name": "number of keys, fractional for objects"})
        num_valid = np.broadcast_to(one.num_valid, replans)
        variables["num_valid"] = ("sample", num_valid, {"long_name": "number of valid keys"})
        parts.append(
            xr.Dataset(
                variables, {**_coordinates(question.selection, one.item, known), "group": names}, _about(question)
            )
        )
    joined: xarray.Dataset = xr.concat(
        parts, "sample", data_vars="minimal", coords="different", compat="equals", join="exact",
        combine_attrs="override",
    )  # fmt: skip
    return joined


def rows_of_episodes(question: Question) -> Iterator[xarray.Dataset]:
    """The rows of one episode after the other, with the roles of their keys: those of all would fill the memory.

    Raises:
        MissingDependency: xarray is not installed.
    """
    xr, selection = _xarray(), question.selection
    bits = question.stores[0].attributes.recording.mantissa_bits
    about = {
        "long_name": "attention probability, mean over the stored queries",
        "units": "1",
        "relative_error": mass_error_bound(bits),
        "absolute_error": key_error_bound(bits),
    }
    for item in question.selected:
        shape = (item.tokens.num_replans, len(selection.layers), len(selection.denoise), len(selection.heads))
        rows = np.empty((*shape, item.tokens.layout.num_keys), dtype=np.float32)
        for part in layer_rows(item.store.attributes, item.episode, selection, question.site, per_head=True):
            rows[:, part.layer, part.denoise] = part.rows
        coordinates = {**_coordinates(selection, item, item.episode.attributes.success is not None), **_keys(item)}
        yield xr.Dataset({"rows": (ROW_DIMENSIONS, rows, about)}, coordinates, _about(question))


def _coordinates(selection: Selection, item: SelectedEpisode, known: bool) -> dict[str, Any]:
    """Episode and environment step of every sample of an episode, and the other axes but groups and keys.

    known: whether outcomes are; no array of numbers has a place for what is not.
    """
    attributes = item.episode.attributes
    of_episode = {
        "suite": item.store.suite,
        "store": item.store.path.name,
        **{name: getattr(attributes, name) for name in ("task_id", "episode_index", "num_steps")},
        "instruction": visible(attributes.instruction),
        "success": attributes.success if known else np.array(attributes.success, dtype=float),
    }
    samples = {name: np.full(attributes.num_replans, value) for name, value in of_episode.items()}
    samples |= {"replan": np.arange(attributes.num_replans), "env_step": item.episode.read("env_step").astype(np.int64)}
    return {
        **{name: ("sample", values) for name, values in samples.items()},
        "layer": ("layer", list(selection.layer_labels), {"long_name": "layer, as the user numbers it"}),
        "block": ("layer", list(selection.blocks), {"long_name": "transformer block"}),
        "denoise": ("denoise", list(selection.denoise_steps), {"long_name": "denoise step"}),
        "denoise_time": ("denoise", item.episode.read("denoise_time")[list(selection.denoise)]),
        "head": ("head", list(selection.head_numbers)),
    }


def _keys(item: SelectedEpisode) -> dict[str, Any]:
    """What every key is: its span, camera, and place among the patches (-1: no patch), and its role at each sample."""
    layout = item.tokens.layout
    of_key, patches = layout.span_of_key(), np.full((2, layout.num_keys), -1, dtype=np.int32)
    for span in layout.spans:
        if span.grid is not None:
            patches[:, span.start : span.stop] = np.divmod(np.arange(span.num_keys), span.grid.columns)
    note = {"comment": "from the top left; -1: no patch"}
    codes: NDArray[Any] = np.array([int(role) for role in Role], dtype=np.uint8)
    meanings = {"flag_values": codes, "flag_meanings": " ".join(role.label for role in Role)}
    return {
        "key_span": ("key", np.array([span.name for span in layout.spans])[of_key]),
        "key_kind": ("key", np.array([span.kind for span in layout.spans])[of_key]),
        "key_camera": ("key", np.array([span.camera or "" for span in layout.spans])[of_key]),
        "patch_row": ("key", patches[0], note),
        "patch_column": ("key", patches[1], note),
        "key_role": (("sample", "key"), item.tokens.key_role, meanings),
    }


def _about(question: Question) -> dict[str, Any]:
    """Attributes of the dataset: text and numbers only, because not every format holds more."""
    root, grouping = question.stores[0].attributes, question.grouping
    sides = (grouping.ratio.numerator, grouping.ratio.denominator) if grouping.ratio is not None else ()
    return {
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
        **({"ratio": " / ".join("+".join(side) for side in sides)} if sides else {}),
    }


def _xarray() -> Any:
    try:
        import xarray
    except ImportError:
        raise MissingDependency(
            f"Labelled arrays need xarray, which is not installed; {install_line('xarray')}."
        ) from None
    return xarray
