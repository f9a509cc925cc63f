"""transformers' own caches: `va.inspect` refuses those whose keys have no place, and no others."""

from __future__ import annotations

import re
from typing import Any

import pytest

pytest.importorskip("transformers", minversion="5.6", reason="run by make test-policies, in .venv-transformers")

import torch
from transformers import Gemma3ForCausalLM, Gemma3TextConfig, LlamaConfig, LlamaForCausalLM

import vla_attention as va

PROMPT, TOKENS, WINDOW = 38, 6, 20
SIZES: dict[str, Any] = {
    **{"hidden_size": 32, "intermediate_size": 32, "num_hidden_layers": 2, "num_attention_heads": 4},
    **{"num_key_value_heads": 2, "head_dim": 8, "vocab_size": 60, "eos_token_id": None},
}


def table(policy: Any, cache: str | None) -> list[str]:
    torch.manual_seed(0)
    ids = torch.randint(3, 50, (1, PROMPT))
    settings = {"cache_implementation": cache, "disable_compile": True} if cache else {}
    return str(
        va.inspect(
            policy.eval(),
            lambda: policy.generate(ids, max_new_tokens=TOKENS, do_sample=False, pad_token_id=0, **settings),
        )
    ).splitlines()


def refused(lines: list[str]) -> list[tuple[str, str]]:
    """The sizes and the reason of each refusal."""
    found = [re.match(r"Recording refuses .*, (\d+ x \S+): its (static|.* loses its first)", line) for line in lines]
    return [(match[1], match[2].split()[-1]) for match in found if match is not None]


def test_a_dynamic_cache_is_recorded():
    assert refused(table(LlamaForCausalLM(LlamaConfig(**SIZES)), None)) == []


def test_a_static_cache_whose_first_call_leaves_the_empty_keys_out():
    lines = table(LlamaForCausalLM(LlamaConfig(**SIZES)), "static")
    assert [line.split()[2:5] for line in lines[2:4]] == [["38", "x", "38"], ["1", "x", "43"]]
    assert refused(lines) == [("1 x 43", "static")]


@pytest.mark.parametrize(("cache", "others"), [(None, []), ("static", [("1 x 43", "static")])])
def test_a_sliding_cache(cache, others):
    config = Gemma3TextConfig(**SIZES, sliding_window=WINDOW, layer_types=["sliding_attention", "full_attention"])
    assert refused(table(Gemma3ForCausalLM(config), cache)) == [(f"1 x {WINDOW}", "first"), *others]
