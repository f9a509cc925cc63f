"""`vla-capture`: the command line of stage one."""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from schemas.command_line import run_command

if TYPE_CHECKING:
    from capture.policies.base import Policy


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit code (2: a mistake in what was given, said in one sentence)."""
    # Set before MuJoCo is imported: GPU nodes and CI have no display.
    os.environ.setdefault("MUJOCO_GL", "egl")
    command = sys.argv[1:] if argv is None else argv
    return run_command("vla-capture", lambda: _capture(command), "complete episodes are kept, continue with --resume.")


def _capture(argv: Sequence[str]) -> int:
    from capture.arguments import build_parser, run_settings
    from capture.store_writer import refuse_existing

    arguments = build_parser().parse_args(argv)
    if arguments.policy == "parity":
        from capture.device import choose_device
        from capture.policies.pi.parity import run_parity

        return run_parity(
            arguments.case,
            arguments.format,
            limit=arguments.limit,
            as_json=arguments.json,
            device=choose_device(arguments.device),
        )
    settings = run_settings(arguments)
    # A store in the way is found before minutes are spent on loading a model.
    if settings.mode == "new" and settings.store.exists():
        refuse_existing(settings.store)

    from capture.device import choose_device
    from capture.run import run_capture, say

    device = choose_device(arguments.device)
    policy = _build_policy(arguments, device)
    results = run_capture(settings, policy, device)
    solved = sum(result.success for result in results)
    say(f"{len(results)} episodes added, {solved} solved. Store: {settings.store}")
    if arguments.output_dir is None and not arguments.save_viz:
        say(f"Next: vla-analyze {settings.store}")
        return 0
    return _analyze(arguments, settings.store)


def _build_policy(arguments: argparse.Namespace, device: str) -> Policy:
    from capture.policies.pi.build import build_pi_policy

    return build_pi_policy(
        arguments.checkpoint,
        tokenizer=arguments.tokenizer,
        device=device,
        checkpoint_format=arguments.checkpoint_format,
        config_name=arguments.config_name,
        model_config=arguments.model_config,
        discrete_state_input=arguments.discrete_state_input,
        dtype=arguments.dtype,
        paligemma_variant=arguments.paligemma_variant,
        action_expert_variant=arguments.action_expert_variant,
        num_image_tokens=arguments.num_image_tokens,
    )


def _analyze(arguments: argparse.Namespace, store: Path) -> int:
    """Run stage two as a process of its own: the two stages share a store, not code."""
    command = [sys.executable, "-m", "analyze", str(store)]
    if arguments.output_dir is not None:
        command += ["--output", str(arguments.output_dir)]
    if arguments.save_viz:
        command += ["--save-viz"]
    return subprocess.run(command, check=False).returncode


if __name__ == "__main__":
    sys.exit(main())
