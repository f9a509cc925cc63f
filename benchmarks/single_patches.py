"""Policy calls made again without some patches: what `effect_maps.py` and `validation/maps.py` measure with.

A call's size of change is the root mean square, over the executed steps and the dimensions of the action, of what
differs in normalised actions.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vla_attention.capture.interventions.factors import SiteEdit, SiteEditor
from vla_attention.capture.policies.policy import CallVariant, PolicyInput, map_keys

#: Calls that are made at a time.
_BATCH = 64


def every_patch(policy: Any) -> NDArray[np.int64]:
    """The keys of the patches of all cameras, each a group of its own, (patch, 1)."""
    return np.array(map_keys(policy))[:, None]


def without(policy: Any, given: PolicyInput, seed: int, keys: Sequence[int] | NDArray[np.int64]) -> CallVariant:
    """The call in which no token reads these keys."""
    site = policy.sites[0]
    factors = np.ones(site.num_keys)
    factors[np.asarray(keys, dtype=np.int64)] = 0.0
    return CallVariant(given, seed, {site.name: SiteEditor(site.name, [SiteEdit("patches", "factor", factors, "all")])})


def sizes(policy: Any, base: CallVariant, variants: Sequence[CallVariant], steps: int) -> NDArray[np.float64]:
    """How far the first `steps` actions of each variant are from those of the base, (variant,)."""
    made = np.stack(policy.act_variants([base, *variants], policy.num_denoise_steps, _BATCH))
    units = policy.action_units()
    moved = np.flatnonzero(units)
    change = (made[1:] - made[:1])[:, :steps, moved] / units[moved]
    found: NDArray[np.float64] = np.sqrt((change**2).mean(axis=(1, 2)))
    return found
