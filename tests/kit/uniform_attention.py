"""Policies whose queries are all zero, so that attention is uniform over the keys that each query sees."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import torch
from torch import nn

import vla_attention as va
from vla_attention.schemas.stores.reader import open_store

#: Ends of the names of modules that project queries, and of those that project queries, keys and values in one.
_QUERIES = ("q_proj", "to_q", "query", "q_b_proj", "q")
_ALL_THREE = ("qkv", "c_attn", "qkv_proj")


@contextmanager
def zeroed_queries(policy: nn.Module) -> Iterator[None]:
    """A policy whose query projections are zero inside the block, and as they were after it."""
    before = {name: value.clone() for name, value in policy.state_dict().items()}
    assert zero_queries(policy) > 0
    try:
        yield
    finally:
        policy.load_state_dict(before)


@torch.no_grad()
def zero_queries(policy: nn.Module) -> int:
    """Set the query projections of a policy to zero; returns how many there are."""
    count = 0
    for name, module in policy.named_modules():
        last = name.rpartition(".")[2]
        if isinstance(module, nn.MultiheadAttention):
            parts = [module.in_proj_weight, module.in_proj_bias]
            rows = module.embed_dim
        elif last in _ALL_THREE:
            parts, rows = [module.weight, module.bias], module.weight.shape[0] // 3
        elif last in _QUERIES and hasattr(module, "weight"):
            parts, rows = [module.weight, module.bias], module.weight.shape[0]
        else:
            continue
        for part in parts:
            if part is not None:
                part[:rows] = 0.0
        count += 1
    return count


def lifts_of_groups(path: Path) -> dict[str, dict[str, list[float | None]]]:
    """Site -> group of the grouping 'default' -> its lift in every cell of a store (replan, layer, denoise, head)."""
    found = {}
    for site in open_store(path).attributes.sites:
        table = va.open(path).analyze(site=site.name, per_head=True)["steps_groups"]
        found[site.name] = {group: part["lift"].to_list() for (group,), part in table.group_by("group")}
    return found


def check_uniform(path: Path, within: float = 1e-5) -> None:
    """Fail unless every group that some query sees has lift 1 everywhere it is seen, and some group is."""
    for site, groups in lifts_of_groups(path).items():
        known = [lift for lifts in groups.values() for lift in lifts if lift is not None]
        assert known, site
        assert max(abs(lift - 1) for lift in known) < within, (site, groups)
