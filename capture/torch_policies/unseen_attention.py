"""Attention that gives no rows: flash-attn, xformers, kernels of other packages; and sentences about it."""

from __future__ import annotations

import re
import sys
from collections.abc import Mapping

from torch import nn

from vla_attention.capture.torch_policies.attention_calls import CallShape
from vla_attention.schemas.errors import BadArgument, listing

#: Operators that compute attention in a way that gives no rows, by their full names.
ATTENTION_OPERATOR = re.compile(
    r"(flash_attn|flash_attn_\w+|xformers|sageattention|spas_sage_attn|torch_attn)::(?!.*rotary)"
    r"|\w+::(?!.*(mask|rotary|metadata|bias)).*(attention|attn|fmha)"
)
LOAD_WITH_SDPA = (
    "Load the model with SDPA: attn_implementation='sdpa' in transformers, the option that turns flash attention or "
    "xformers off elsewhere."
)
#: transformers' names of attention that runs in kernels of other packages.
_UNSEEN_SETTING = re.compile(r"flash|paged|sage|kernels-community|.+/.+|.*@")
#: Packages whose kernels no Python mode sees.
_PACKAGES = ("flash_attn", "flash_attn_interface", "xformers", "sageattention", "transformer_engine")


class UnseenAttention(BadArgument):
    """Attention that is computed in a way that gives no rows."""


def refuse_unseen_settings(modules: Mapping[str, nn.Module]) -> None:
    """Raise `UnseenAttention` if transformers or diffusers are set to kernels of other packages."""
    for path, module in modules.items():
        # Not getattr on the module: what it lacks is slow to ask for, and there are thousands of modules.
        attributes = module.__dict__
        setting = getattr(attributes.get("config"), "_attn_implementation", None)
        processor = type(attributes.get("processor")).__name__
        if isinstance(setting, str) and _UNSEEN_SETTING.match(setting):
            kernels = f"attn_implementation='{setting}'"
        elif re.search(r"XFormers|Flash|Sage", processor):
            kernels = f"the processor {processor}"
        else:
            continue
        raise UnseenAttention(
            f"{path or 'The policy'} runs attention with {kernels}, which gives no rows. {LOAD_WITH_SDPA}"
        )


def no_attention(policy: object, unmet: Mapping[int, tuple[CallShape, str]]) -> str:
    """Return the sentence about a policy in which no attention was seen; unmet: see `Watcher`."""
    loaded = [package for package in _PACKAGES if package in sys.modules]
    reason = (
        f"{listing(loaded)} is loaded, whose kernels nothing sees. {LOAD_WITH_SDPA}"
        if loaded
        else "Policies without attention, such as a U-Net of diffusion policy, cannot be recorded; a policy that "
        "answers from a queue computes attention only when the queue is empty, so reset it before the call. A softmax "
        "that is written with exp and sum, and functions of TorchScript, are not seen either."
    )
    if unmet:
        softmaxes = dict.fromkeys(f"{shape} (followed up to {function})" for shape, function in unmet.values())
        reason = f"Softmaxes whose results met no values in a product: {listing(softmaxes, 4)}. {reason}"
    return f"The policy ({type(policy).__name__}) computed no attention that can be seen. {reason}"
