"""A stand-in for torchvision, which LeRobot imports everywhere and whose real package brings another torch.

What nobody calls here is a placeholder class. ACT's picture network is a small convolution net with the stride of a
ResNet (32), so that the rest of ACT is the real class.
"""

from __future__ import annotations

import sys
from importlib.machinery import ModuleSpec
from types import ModuleType, SimpleNamespace
from typing import Any

import torch
from torch import Tensor, nn

_MODULES = (
    *("", "transforms", "transforms.v2", "transforms.v2.functional", "transforms.functional", "io", "models"),
    *("models._utils", "ops", "ops.misc", "utils"),
)


class _StandIn(ModuleType):
    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        # Derived from `nn.Module` and from nothing else: LeRobot derives transforms of its own from it.
        thing = type(name, (nn.Module,), {"__module__": self.__name__})
        setattr(self, name, thing)
        return thing


class SmallResNet(nn.Module):
    """A net whose `layer4` has the stride 32, in the place of torchvision's ResNets."""

    def __init__(self, channels: int = 8) -> None:
        super().__init__()
        self.stem = nn.Conv2d(3, channels, kernel_size=4, stride=4)
        self.layer4 = nn.Conv2d(channels, channels, kernel_size=8, stride=8)
        self.fc = SimpleNamespace(in_features=channels)


class FeatureMap(nn.Module):
    """The output of `layer4` under its name, as torchvision's `IntermediateLayerGetter` gives it."""

    def __init__(self, model: SmallResNet, return_layers: dict[str, str]) -> None:
        super().__init__()
        self.stem, self.layer4, self.name = model.stem, model.layer4, return_layers["layer4"]

    def forward(self, pictures: Tensor) -> dict[str, Tensor]:
        """Return the feature map (batch, channel, row, column)."""
        return {self.name: self.layer4(torch.relu(self.stem(pictures)))}


def install() -> None:
    """Put the stand-in where `import torchvision` finds it, unless the real one is installed."""
    try:
        import torchvision  # noqa: F401
    except ImportError:
        pass
    else:
        return
    for name in _MODULES:
        full = f"torchvision.{name}" if name else "torchvision"
        module = _StandIn(full)
        module.__spec__ = ModuleSpec(full, None, is_package=True)
        module.__path__ = []
        sys.modules[full] = module
        parent, _, child = full.rpartition(".")
        if parent:
            setattr(sys.modules[parent], child, module)
    sys.modules["torchvision"].__version__ = "0"  # type: ignore[attr-defined]
    sys.modules["torchvision.models"].resnet18 = lambda **_: SmallResNet()  # type: ignore[attr-defined]
    sys.modules["torchvision.models._utils"].IntermediateLayerGetter = FeatureMap  # type: ignore[attr-defined]
