"""The cameras that a policy sees, and the mean attention on every key over a selection."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from vla_attention.analyze.measures.baselines import uniform_keys
from vla_attention.analyze.measures.selected import SelectedEpisode
from vla_attention.analyze.stores.rows import layer_rows
from vla_attention.analyze.stores.selection import Selection
from vla_attention.schemas.layout import Role


def seen_cameras(item: SelectedEpisode) -> tuple[str, ...]:
    """Cameras of the site whose patches are not all masked, in key order."""
    layout, roles = item.tokens.layout, item.tokens.static_roles
    spans = [(camera, layout.camera_span(camera)) for camera in layout.cameras]
    return tuple(
        camera
        for camera, span in spans
        if span.grid is not None and (roles[:, span.start : span.stop] == Role.IMAGE).any()
    )


def mean_rows(item: SelectedEpisode, selection: Selection, site: str) -> NDArray[np.float64]:
    """Probability of every key, shape (replan, key): mean over the selected layers, denoise steps and heads.

    A block that was named by two layer numbers counts once.
    """
    total, count = 0.0, 0
    for part in layer_rows(item.store.attributes, item.episode, selection, site, per_head=True):
        if selection.is_first_of_block(part.layer):
            total, count = total + part.rows.mean(axis=1, dtype=np.float64), count + 1
    return np.asarray(total) / count


def mean_uniform(item: SelectedEpisode, selection: Selection) -> NDArray[np.float64]:
    """What `mean_rows` is for uniform attention, shape (replan or 1, key)."""
    uniform = uniform_keys(item, selection).mean(axis=(2, 3))
    once = [i for i in range(len(selection.blocks)) if selection.is_first_of_block(i)]
    means: NDArray[np.float64] = (uniform[:, once] if uniform.shape[1] > 1 else uniform).mean(axis=1)
    return means
