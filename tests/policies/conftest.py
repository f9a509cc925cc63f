"""Tests of policies of other packages. Each file says in which environment it runs; elsewhere it is skipped."""

from __future__ import annotations

from importlib.util import find_spec

if find_spec("lerobot") is not None:
    from tests.policies import stand_in_torchvision

    stand_in_torchvision.install()
