"""Record attention inside lerobot-eval: its own command line, with the store in an environment variable.

    pip install examples/lerobot_plugin
    VLA_ATTENTION_STORE=runs/smolvla_libero.zarr lerobot-eval \\
        --policy.path=HuggingFaceVLA/smolvla_libero --env.type=libero --env.task=libero_spatial \\
        --eval.n_episodes=10 --eval.batch_size=5
    vla-attention analyze runs/smolvla_libero.zarr

Every command of LeRobot imports this package before it reads its arguments. Without the variable nothing happens.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path

VARIABLE = "VLA_ATTENTION_STORE"


def begin(store: str, command: str) -> None:
    """Let lerobot-eval write a store; say that another command writes none."""
    if command != "lerobot-eval":
        print(f"{VARIABLE} is set, but {command} records nothing: only the command lerobot-eval does.")
        return
    try:
        from lerobot_policy_vla_attention.recorder import Recorder

        Recorder(store).install()
    except Exception as error:
        # LeRobot would log any other exception, evaluate, and record nothing.
        sys.exit(f"{VARIABLE} is set, but attention cannot be recorded: {error}")


if os.environ.get(VARIABLE):
    begin(os.environ[VARIABLE], Path(sys.argv[0]).stem)
