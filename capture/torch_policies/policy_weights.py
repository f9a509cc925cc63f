"""The weights of a policy: their digest, device and type, and its output projections."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from vla_attention.capture.policies.weights import weights_digest
from vla_attention.capture.torch_policies.policy_layout import PolicyLayout
from vla_attention.capture.torch_policies.policy_modules import modules_of
from vla_attention.capture.torch_policies.tensor_functions import tensors_among
from vla_attention.schemas.errors import BadArgument, did_you_mean, unknown_name


def find_module(policy: object, path: str, what: str) -> nn.Module:
    """Return the module at a path; the error says what it was wanted for, and the nearest that exists."""
    modules = modules_of(policy)
    if path not in modules:
        raise unknown_name(f"module for {what}", path, [name for name in modules if name])
    return modules[path]


def _roots(policy: object) -> dict[str, nn.Module]:
    """The modules of a policy that are in no other one, by path."""
    inside: set[int] = set()
    roots = {}
    for path, module in modules_of(policy).items():
        if id(module) not in inside:
            roots[path] = module
            inside.update(id(part) for part in module.modules())
    return roots


def policy_digest(policy: object) -> str:
    """Return the SHA-256 (hex) over the weights of all modules of a policy."""
    roots = _roots(policy)
    if len(roots) == 1:
        return weights_digest(next(iter(roots.values())))
    digest = hashlib.sha256()
    for name, module in sorted(roots.items()):
        digest.update(f"{name} {weights_digest(module)}\n".encode())
    return digest.hexdigest()


def weights_state(policy: object) -> tuple[tuple[int, int], ...]:
    """Return what tells quickly that weights may have changed: where they are, and how often torch wrote to them.

    What is written through `.data` is not counted.
    """
    return tuple(
        (weight.data_ptr(), 0 if weight.is_inference() else weight._version)
        for module in _roots(policy).values()
        for weight in module.parameters()
    )


def device_and_dtype(policy: object) -> tuple[str, str]:
    """Return the device and the type of most weights, such as `cuda:0` and `bfloat16`."""
    counts: dict[tuple[str, str], int] = {}
    for module in _roots(policy).values():
        for weight in module.parameters():
            place = str(weight.device), str(weight.dtype).removeprefix("torch.")
            counts[place] = counts.get(place, 0) + weight.numel()
    return max(counts, key=lambda place: counts[place]) if counts else ("cpu", "float32")


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
            return module if module.weight.is_floating_point() else None
        return None

    def _called(self, mixed: Tensor) -> Tensor:
        # Quantised weights, adapters: the module itself.
        weights = (weight.dtype for weight in self.module.parameters() if weight.is_floating_point())
        result = self.module(mixed.to(next(weights, mixed.dtype)))
        return next(tensors_among((result,))).float()


def projections_of(
    policy: object, layout: PolicyLayout, layers: tuple[int, ...]
) -> dict[tuple[str, int], OutputProjection]:
    """Return (site, block) -> the output projection of a block, for the recorded layers."""
    modules = modules_of(policy)
    found = {}
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
            found[site.name, block] = OutputProjection(modules[path], path)
    return found
