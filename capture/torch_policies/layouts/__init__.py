"""Layouts of policies that people run: a function of a policy object returns its `PolicyLayout`.

What is fixed by the policy's configuration is read from it; what a call decides (prompt, cameras of a processor) is an
argument. docs/my-policy.md says with which versions each was tried, and what was checked.
"""

from vla_attention.capture.torch_policies.layouts.act import act
from vla_attention.capture.torch_policies.layouts.eo1 import eo1
from vla_attention.capture.torch_policies.layouts.evo1 import evo1
from vla_attention.capture.torch_policies.layouts.fastwam import fastwam
from vla_attention.capture.torch_policies.layouts.gr00t import gr00t
from vla_attention.capture.torch_policies.layouts.molmoact2 import molmoact2
from vla_attention.capture.torch_policies.layouts.multi_task_dit import multi_task_dit
from vla_attention.capture.torch_policies.layouts.openvla import openvla, openvla_oft
from vla_attention.capture.torch_policies.layouts.pi0 import pi0_fast, pi0_pytorch, pi0_transformers
from vla_attention.capture.torch_policies.layouts.smolvla import smolvla
from vla_attention.capture.torch_policies.layouts.vla_jepa import vla_jepa
from vla_attention.capture.torch_policies.layouts.vqbet import vqbet
from vla_attention.capture.torch_policies.layouts.wall_x import wall_x
from vla_attention.capture.torch_policies.layouts.xvla import xvla

__all__ = [
    "act", "eo1", "evo1", "fastwam", "gr00t", "molmoact2", "multi_task_dit", "openvla", "openvla_oft", "pi0_fast",
    "pi0_pytorch", "pi0_transformers", "smolvla", "vla_jepa", "vqbet", "wall_x", "xvla",
]  # fmt: skip
