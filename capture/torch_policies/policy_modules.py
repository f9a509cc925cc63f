"""The modules that a policy holds, by path, and policies whose attention no Python code computes."""

from __future__ import annotations

import types
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field

import torch
from torch import Tensor, nn

from vla_attention.capture.torch_policies.attention_calls import CallShape
from vla_attention.capture.torch_policies.policy_layout import PolicyLayout
from vla_attention.capture.torch_policies.tensor_functions import tensors_among
from vla_attention.capture.torch_policies.unseen_attention import refuse_unseen_settings
from vla_attention.schemas.errors import BadArgument, did_you_mean, unknown_name

#: How deep modules are looked for in objects that are no modules.
DEPTH = 4
#: Lists and dictionaries with more entries are not looked into.
MANY = 1000
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
        attending: those in whose own forward attention can run.
        simple: the others that have a forward: torch's modules without children, such as `nn.Linear`.
        softmaxes: filled by blocks that look at every function: what a softmax by hand turned out to be, if all that
            looked alike were attention of one shape, and None if not; see `WatchedBlock.expected`.
    """

    policy: object
    modules: Mapping[str, nn.Module]
    attending: tuple[nn.Module, ...]
    simple: tuple[nn.Module, ...]
    softmaxes: dict[CallShape, CallShape | None] = field(default_factory=dict)


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
    running = [module for module in modules.values() if type(module).forward is not nn.Module.forward]
    attending = tuple(module for module in running if _may_attend(module))
    return FoundPolicy(policy, modules, attending, tuple(module for module in running if not _may_attend(module)))


def _may_attend(module: nn.Module) -> bool:
    """Whether attention can run in a module's own forward: not in torch's modules without children."""
    return bool(module._modules) or not type(module).__module__.startswith("torch.nn.")


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
    seen: set[int] = set()
    for path, part in _parts(policy, "", 0, seen):
        name = f"{type(part).__module__}.{type(part).__qualname__}"
        if isinstance(part, nn.Module):
            graphed = getattr(part.__dict__.get("forward"), "__module__", "") == "torch.cuda.graphs"
            name = "a CUDA graph of make_graphed_callables" if graphed else name
        else:
            graphed = False
        if graphed or isinstance(part, torch.jit.ScriptModule) or name.startswith(_COMPILED):
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
    if id(part) in seen:
        return
    seen.add(id(part))
    if isinstance(part, nn.Module):
        scripted = isinstance(part, torch.jit.ScriptModule)
        inner = None if scripted else part._modules.get("_orig_mod")
        if inner is not None:
            # torch.compile's wrapper gives way to what it wraps, which runs in the block.
            yield from _parts(inner, path, depth, seen)
            return
        yield path, part
        if scripted:
            return
        for name, child in part._modules.items():
            if child is not None:
                yield from _parts(child, _joined(path, name), depth, seen)
        attributes = {name: held for name, held in part.__dict__.items() if name not in MODULE_ATTRIBUTES}
        if depth < DEPTH:
            for name, held in attributes.items():
                yield from _held(held, _joined(path, name), depth + 1, seen)
    else:
        yield from _held(part, path, depth, seen)


#: What every nn.Module has.
MODULE_ATTRIBUTES = frozenset(nn.Module().__dict__)


def _held(part: object, path: str, depth: int, seen: set[int]) -> Iterator[tuple[str, object]]:
    """Yield what an object that is no module holds."""
    if isinstance(part, nn.Module):
        yield from _parts(part, path, depth, seen)
        return
    plain = (str, bytes, int, float, complex, bool, type(None), torch.Tensor, type, types.ModuleType, torch.dtype)
    if isinstance(part, plain):
        return
    if id(part) in seen and depth:
        return
    seen.add(id(part))
    if f"{type(part).__module__}.{type(part).__qualname__}".startswith(_COMPILED):
        yield path, part
        return
    if depth >= DEPTH:
        return
    if isinstance(part, dict | list | tuple | set | frozenset) and len(part) > MANY:
        return  # vocabularies and data, no modules
    if isinstance(part, dict):
        items = [(str(name), held) for name, held in part.items()]
    elif isinstance(part, list | tuple | set | frozenset):
        items = [(str(number), held) for number, held in enumerate(part)]
    elif isinstance(part, types.MethodType):
        items = []
    else:
        items = list(getattr(part, "__dict__", {}).items()) if not callable(type(part).__dict__.get("__get__")) else []
    for name, held in items:
        yield from _held(held, _joined(path, name), depth + 1, seen)


def _joined(path: str, name: str) -> str:
    return f"{path}.{name}" if path else name


def find_module(policy: object, path: str, what: str) -> nn.Module:
    """Return the module at a path; the error says what it was wanted for, and the nearest that exists."""
    modules = modules_of(policy)
    if path not in modules:
        raise unknown_name(f"module for {what}", path, [name for name in modules if name])
    return modules[path]


def root_modules(policy: object) -> dict[str, nn.Module]:
    """The modules of a policy that are in no other one, by path."""
    inside: set[int] = set()
    roots = {}
    for path, module in modules_of(policy).items():
        if id(module) not in inside:
            roots[path] = module
            inside.update(id(part) for part in module.modules())
    return roots


@dataclass(frozen=True)
class OutputProjection:
    """The output projection of a block, by its module and path."""

    module: nn.Module
    path: str

    def __call__(self, mixed: Tensor) -> Tensor:
        """Map mixed values (..., head · dim) float32 to (..., width), without a bias: no key gives it."""
        if (linear := self._linear) is not None:
            return nn.functional.linear(mixed, linear.weight.to(mixed.dtype))
        flat = mixed.flatten(0, -2)
        both = self._called(torch.cat([flat, torch.zeros_like(flat[:1])]))
        return (both[:-1] - both[-1:]).view(*mixed.shape[:-1], -1)

    def bias(self, mixed: Tensor) -> Tensor:
        """Return what it gives for zeros, (width,) float32; mixed: values of the size that it takes."""
        if (linear := self._linear) is not None:
            zeros = linear.weight.new_zeros(len(linear.weight), dtype=torch.float32)
            return zeros if linear.bias is None else linear.bias.float()
        return self._called(torch.zeros_like(mixed.flatten(0, -2)[:1]))[0]

    @property
    def _linear(self) -> nn.Linear | None:
        module = self.module
        if isinstance(module, nn.Linear) and type(module).forward is nn.Linear.forward:
            plain = type(module.weight) in (Tensor, nn.Parameter) and not module.weight.is_meta
            return module if plain and module.weight.is_floating_point() else None
        return None

    def _called(self, mixed: Tensor) -> Tensor:
        # Quantised or offloaded weights, adapters: the module itself.
        weights = (weight.dtype for weight in self.module.parameters() if weight.is_floating_point())
        result = self.module(mixed.to(next(weights, mixed.dtype)))
        return next(tensors_among((result,))).float()


def projections_of(
    policy: object, layout: PolicyLayout, layers: tuple[int, ...]
) -> dict[tuple[str, int], OutputProjection]:
    """Return (site, block) -> the output projection of a block, for the recorded layers."""
    modules = modules_of(policy)
    projections = {}
    for site in layout.sites:
        if site.projection is None:
            raise BadArgument(
                f"Contributions need the output projection of site '{site.name}', and the layout '{layout.name}' names "
                "none: record with contributions=False."
            )
        for block in site.keys.layers or range(layout.num_layers):
            if block not in layers:
                continue
            path = site.projection.replace("{block}", str(block))
            if path not in modules:
                raise BadArgument(
                    f"The output projection '{path}' of site '{site.name}' is no module of the policy."
                    f"{did_you_mean(path, modules)} Change RecordedSite.projection, or record with contributions=False."
                )
            projections[site.name, block] = OutputProjection(modules[path], path)
    return projections
