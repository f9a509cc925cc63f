"""The weights of a policy of the caller: their digest, whether they changed, and where most of them are.

Policies hold more than plain tensors: packed and quantised weights, weights that a library keeps elsewhere, a state of
their own. Whatever has bytes is read, and the rest is named: a digest never ends a recording.
"""

from __future__ import annotations

import hashlib
import io
import re
from collections import Counter
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from vla_attention.capture.torch_policies.policy_modules import root_modules


def policy_digest(policy: object) -> tuple[str, tuple[str, ...]]:
    """Return the SHA-256 (hex) over the weights and further state of all modules, and the names of what has no bytes.

    Without bytes are weights on torch's meta device (offloaded, or not made yet) and objects that are no numbers.
    """
    digest, unread = hashlib.sha256(), []
    roots = root_modules(policy)
    for root, module in sorted(roots.items()):
        for name, value in _state(module):
            full = f"{root}.{name}" if root and len(roots) > 1 else name
            try:
                parts = list(_bytes(value))
            except Exception:  # of a subclass of tensors, or of what a library made of the attribute
                parts = []
            if not parts:
                unread.append(full)
            digest.update(f"{full} {type(value).__name__}\n".encode())
            for part in parts:
                digest.update(part)
    return digest.hexdigest(), tuple(unread)


def _state(module: nn.Module) -> Iterator[tuple[str, Any]]:
    """Yield name and value of everything that a module would save, ordered by name; None where it cannot say what."""
    try:
        state = module.state_dict()
    except Exception:  # of one module's own code: then each is asked by itself
        state = {}
        for path, part in module.named_modules():
            prefix = f"{path}." if path else ""
            try:
                own: dict[str, Any] = {}
                part._save_to_state_dict(own, prefix, False)
            except Exception:
                own = {prefix + name: value for name, value in (*part._parameters.items(), *part._buffers.items())}
                own[f"{prefix}(state)"] = None
            state.update(own)
    yield from sorted(state.items(), key=lambda item: item[0])


def _bytes(value: Any) -> Iterator[bytes | memoryview]:
    """Yield the bytes of a value of a module's state; nothing, or an error, where it has none."""
    if isinstance(value, Tensor):
        yield from _bytes_of_tensor(value)
    elif isinstance(value, bool | int | float | complex | str | torch.dtype | torch.Size):
        yield repr(value).encode()
    elif isinstance(value, bytes | bytearray):
        yield bytes(value)
    elif isinstance(value, io.BytesIO):
        yield value.getvalue()
    elif isinstance(value, np.ndarray) and not value.dtype.hasobject:
        yield f"{value.dtype} {value.shape}".encode() + value.tobytes()
    elif isinstance(value, Mapping):
        yield from _all([part for key in sorted(value, key=repr) for part in (key, value[key])])
    elif isinstance(value, list | tuple):
        yield from _all(list(value))
    elif isinstance(value, torch.ScriptObject):  # packed weights of torch.ao
        yield from _bytes(value.__getstate__())


def _all(values: list[Any]) -> Iterator[bytes | memoryview]:
    """Yield the bytes of several values, which all must have some; None stands for what is not there."""
    yield f"{len(values)} values".encode()
    for value in values:
        parts: list[bytes | memoryview] = [b"none"] if value is None else list(_bytes(value))
        if not parts:
            raise TypeError(f"a {type(value).__name__} has no bytes")
        yield from parts


def _bytes_of_tensor(tensor: Tensor) -> Iterator[bytes | memoryview]:
    if tensor.is_meta or nn.parameter.is_lazy(tensor):
        return
    tensor = tensor.detach()
    head = f"{tensor.dtype} {tuple(tensor.shape)}".encode()
    if hasattr(tensor, "__tensor_flatten__"):  # a subclass that holds tensors, such as torchao's
        names, context = tensor.__tensor_flatten__()
        context = re.sub(r" at 0x[0-9a-f]+", "", str(context))  # of an object that says only where it is in memory
        yield from _all([head, context, *(getattr(tensor, name) for name in names)])
    elif tensor.is_nested:
        yield from _all([head, *tensor.unbind()])
    elif tensor.is_quantized:
        yield from _all([head, tensor.int_repr(), tensor.dequantize()])
    else:
        if tensor.layout is not torch.strided:
            tensor = tensor.to_dense()
        plain = tensor.resolve_conj().resolve_neg().cpu().contiguous()
        yield head
        # Read as bytes, because numpy knows neither bfloat16 nor numbers of less than 8 bits.
        if plain.numel():
            yield plain.reshape(-1).view(torch.uint8).numpy().data


#: How many numbers of each weight are summed up.
_SAMPLED = 16


def weights_state(policy: object) -> tuple[tuple[int, int, float], ...]:
    """Return what tells quickly that weights may have changed: where they are, how often torch wrote to them, a sum.

    The sum is of a few numbers of each: torch does not count what is written through `.data`, as of a moving average.
    A tensor that has no memory of its own is not looked at.
    """
    weights = [weight for module in root_modules(policy).values() for weight in module.parameters()]
    sums: dict[int, float] = {}
    with torch.no_grad():
        sampled = {number: sample for number, weight in enumerate(weights) if (sample := _sample(weight)) is not None}
        for device in {sample.device for sample in sampled.values()}:  # one transfer for each
            there = [number for number, sample in sampled.items() if sample.device == device]
            sums.update(zip(there, torch.stack([sampled[number] for number in there]).tolist(), strict=True))
    return tuple((*_place(weight), sums.get(number, 0.0)) for number, weight in enumerate(weights))


def _sample(weight: Tensor) -> Tensor | None:
    """The sum of some numbers of a weight, float64; None where they cannot be read."""
    try:
        first = weight.detach()[(0,) * (weight.ndim - 1)] if not weight.is_contiguous() else weight.detach().view(-1)
        return None if weight.is_meta else first[:: len(first) // _SAMPLED + 1].double().nan_to_num().sum()
    except Exception:  # not made yet, packed, or a subclass that knows no such functions
        return None


def _place(weight: Tensor) -> tuple[int, int]:
    try:
        return weight.data_ptr(), 0 if weight.is_inference() else weight._version
    except (RuntimeError, ValueError, NotImplementedError):  # not made yet, or a subclass without memory of its own
        return 0, 0


def device_and_dtype(policy: object) -> tuple[str, str]:
    """Return the device and the type of most weights, such as `cuda:0` and `bfloat16`."""
    counts: Counter[tuple[str, str]] = Counter()
    for module in root_modules(policy).values():
        for weight in module.parameters():
            if not weight.is_meta and not nn.parameter.is_lazy(weight):
                counts[str(weight.device), str(weight.dtype).removeprefix("torch.")] += weight.numel()
    return counts.most_common(1)[0][0] if counts else ("cpu", "float32")
