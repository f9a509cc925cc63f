"""The modules that a policy holds, by path, and policies whose attention no Python code computes."""

from __future__ import annotations

import types
from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import nn

from vla_attention.capture.torch_policies.unseen_attention import refuse_unseen_settings
from vla_attention.capture.torch_policies.watched_places import WatchedPlaces
from vla_attention.schemas.errors import BadArgument

#: How deep modules are looked for in objects that are no modules.
_DEPTH = 4
#: Lists and dictionaries with more entries are not looked into.
_MANY = 1000
#: Classes whose instances run a compiled program, by the beginning of their full names.
_COMPILED = (
    "torch.jit.", "torch._inductor.package.", "torch_tensorrt.", "tensorrt.", "onnxruntime.",
    "torch.cuda.graphs.CUDAGraph", "torch._inductor.runtime.", "torch.export.exported_program.", "openvino.",
)  # fmt: skip


class NoModules(BadArgument):
    """What was given as a policy holds no torch module."""


class CannotRunEager(BadArgument):
    """A policy, or a part of it, that is compiled so that its attention cannot be seen."""


@dataclass(frozen=True)
class FoundPolicy:
    """A policy whose modules are known already: `watch_attention` looks for them once and not at every block.

    Attributes:
        policy: what was given.
        modules: by path, see `modules_of`.
        places: where it computes attention, which its calls show.
    """

    policy: object
    modules: Mapping[str, nn.Module]
    places: WatchedPlaces = field(default_factory=WatchedPlaces)


def find_policy(policy: object) -> FoundPolicy:
    """Look for the modules of a policy, once for many blocks.

    Raises:
        NoModules, CannotRunEager: see `modules_of`.
        UnseenAttention: it is set to attention that gives no rows.
    """
    if isinstance(policy, FoundPolicy):
        return policy
    modules = modules_of(policy)
    refuse_unseen_settings(modules)
    return FoundPolicy(policy, modules)


def modules_of(policy: object) -> dict[str, nn.Module]:
    """Return the modules of a policy by path; "" is the policy itself, if it is a module.

    policy: an `nn.Module`, or an object that holds modules in its attributes, in lists or dictionaries too. What
    `torch.compile` puts around a module is no part of a path.

    Raises:
        NoModules: no module is found.
        CannotRunEager: a part is a compiled program: TorchScript, TensorRT, AOTInductor, a CUDA graph ...
    """
    policy = getattr(policy, "__self__", policy) if isinstance(policy, types.MethodType) else policy
    modules: dict[str, nn.Module] = {}
    for path, part in _parts(policy, "", 0, set()):
        name, forward = _class_name(part), getattr(part, "__dict__", {}).get("forward")
        graphed = isinstance(part, nn.Module) and getattr(forward, "__module__", "") == "torch.cuda.graphs"
        if graphed or isinstance(part, torch.jit.ScriptModule) or name.startswith(_COMPILED):
            name = "a CUDA graph of make_graphed_callables" if graphed else name
            raise CannotRunEager(
                f"{path or 'The policy'} is a compiled program ({name}): its attention cannot be seen, and it cannot "
                "be made eager. Load the policy as an ordinary torch module; torch.compile is fine."
            )
        if isinstance(part, nn.Module):
            modules.setdefault(path, part)
    if not modules:
        raise NoModules(
            f"The policy ({type(policy).__name__}) holds no torch module. Give the nn.Module itself, or an object with "
            "the module among its attributes."
        )
    return modules


def _parts(part: object, path: str, depth: int, seen: set[int]) -> Iterator[tuple[str, object]]:
    """Yield modules and compiled programs of an object by path, each once."""
    if isinstance(part, _PLAIN) or id(part) in seen:
        return
    seen.add(id(part))
    if isinstance(part, nn.Module) and not isinstance(part, torch.jit.ScriptModule):
        if part._modules.get("_orig_mod") is not None:
            # torch.compile's wrapper gives way to what it wraps, which runs in the block.
            yield from _parts(part._modules["_orig_mod"], path, depth, seen)
            return
        yield path, part
        for name, child in part._modules.items():
            yield from _parts(child, _joined(path, name), depth, seen)
    elif isinstance(part, nn.Module) or _class_name(part).startswith(_COMPILED):
        yield path, part
        return
    if depth < _DEPTH:
        for name, held in _held(part):
            yield from _parts(held, _joined(path, str(name)), depth + 1, seen)


#: What holds no modules.
_PLAIN = (str, bytes, int, float, complex, bool, type(None), torch.Tensor, type, types.ModuleType, torch.dtype)
#: What every nn.Module has.
_MODULE_ATTRIBUTES = frozenset(nn.Module().__dict__)


def _held(part: object) -> list[tuple[Any, object]]:
    """What an object holds, with the names of its attributes and the keys or numbers of its entries."""
    if isinstance(part, dict | list | tuple | set | frozenset):
        if len(part) > _MANY:
            return []  # vocabularies and data, no modules
        return list(part.items() if isinstance(part, dict) else enumerate(part))
    if isinstance(part, types.MethodType) or callable(type(part).__dict__.get("__get__")):
        return []
    held = getattr(part, "__dict__", {}).items()
    return [item for item in held if not isinstance(part, nn.Module) or item[0] not in _MODULE_ATTRIBUTES]


def _joined(path: str, name: str) -> str:
    return f"{path}.{name}" if path else name


def _class_name(part: object) -> str:
    return f"{type(part).__module__}.{type(part).__qualname__}"


def root_modules(policy: object) -> dict[str, nn.Module]:
    """The modules of a policy that are in no other one, by path."""
    inside: set[int] = set()
    roots = {}
    for path, module in modules_of(policy).items():
        if id(module) not in inside:
            roots[path] = module
            inside.update(id(part) for part in module.modules())
    return roots


def blocks_without_calls(modules: Mapping[str, nn.Module], ran: Collection[int], calls: Iterable[str]) -> list[str]:
    """Return the paths of repeated blocks that ran and made no attention call, where others of their list made some.

    modules: by path. ran: the ids of those that ran. calls: the paths of modules that made attention calls.
    """
    paths, found, lists = set(calls), [], list[str]()
    for path, module in modules.items():
        if not isinstance(module, nn.ModuleList) or any(path.startswith(f"{outer}.") for outer in lists):
            continue
        blocks = {_joined(path, name): block for name, block in module.named_children()}
        calling = {block for block in blocks if any(f"{call}.".startswith(f"{block}.") for call in paths)}
        if not calling:
            continue
        lists.append(path)
        kinds = Counter(type(block) for block in blocks.values())
        found += [
            name
            for name, block in blocks.items()
            if name not in calling and kinds[type(block)] > 1 and any(id(part) in ran for part in block.modules())
        ]
    return found
