"""The table of cases of what uniform attention gives, which Python and the viewer's page share, and stores of them.

`stored`: who sees what (`seen`: replan, layer, denoise step, head, query, key; one entry stands for
all), what uniform attention then gives over selections (replan, key), and lifts of the groups of `default` for
attention that is shared out by `weights` among the keys that a query sees.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tests.kit.paths import ROOT
from tests.kit.stores import StoreSpec, write_store
from vla_attention.schemas.groupings.vocabulary import EpisodeTokens
from vla_attention.schemas.jsonable import from_json
from vla_attention.schemas.layout import Prompt, SiteLayout

TABLE: dict[str, Any] = json.loads((ROOT / "tests/schemas/groupings/uniform_cases.json").read_text(encoding="utf-8"))
#: Layers, denoise steps, heads and action queries of the cases `stored`.
LENGTHS = (2, 2, 2, 3)


def layout_of(case: dict[str, Any]) -> SiteLayout:
    """The layout that a case names."""
    return from_json(SiteLayout, TABLE["layouts"][case["layout"]])


def tokens_of_case(case: dict[str, Any]) -> EpisodeTokens:
    """The tokens of a case; its text has no words."""
    roles = np.array(case["key_role"], dtype=np.uint8)
    return EpisodeTokens(layout_of(case), roles, (Prompt("", (), (0, 0)),), np.zeros(len(roles), np.int32))


def attention(case: dict[str, Any], weights: list[float]) -> NDArray[np.float64]:
    """Rows of a case (replan, layer, denoise, head, query, key), in proportion to `weights` on what a query sees.

    Axes along which nothing changes have length 1; where the case keeps the mean over queries, so has theirs.
    """
    lines = np.array(case["seen"])
    seen = np.array([[int(mark) for mark in line] for line in lines.ravel()]).reshape(*lines.shape, -1)
    shares = seen * np.array(weights, np.float64)
    rows: NDArray[np.float64] = shares / shares.sum(axis=-1, keepdims=True)
    return rows.mean(axis=4, keepdims=True) if case["queries"] == "mean" else rows


def write_case(path: Path, case: dict[str, Any], weights: list[float]) -> Path:
    """A store of one episode with the `attention` of a case; weights of 1 make it uniform."""
    layers, denoise, heads, queries = LENGTHS
    spec = StoreSpec(
        tokens=tokens_of_case(case),
        tasks=(0,),
        episodes=1,
        layers=tuple(range(layers)),
        num_layers=layers,
        denoise_steps=tuple(range(denoise)),
        heads=tuple(range(heads)),
        queries=case["queries"],
        num_action_queries=queries,
        mantissa_bits=23,
        frames=False,
        coverage=False,
        plant_rows=lambda _task, _episode, _tokens, rows: np.broadcast_to(attention(case, weights), rows.shape),
        plant_uniform=lambda _tokens, _cells: attention(case, [1.0] * len(weights)),
    )
    return write_store(path, spec=spec)
