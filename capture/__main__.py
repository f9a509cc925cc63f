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
from schemas.errors import BadArgument

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
        return _parity(arguments)
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


def _parity(arguments: argparse.Namespace) -> int:
    from capture.device import choose_device
    from capture.policies.cosmos.case import case_kind

    device = choose_device(arguments.device)
    if case_kind(arguments.case) is not None:
        from capture.policies.cosmos.parity import run_cosmos_parity

        if arguments.format is not None or arguments.limit is not None:
            raise BadArgument("Cosmos cases have one format and their own limits; leave out --format and --limit.")
        return run_cosmos_parity([arguments.case], as_json=arguments.json, device=device)
    from capture.policies.pi.parity import run_parity

    return run_parity(arguments.case, arguments.format, limit=arguments.limit, as_json=arguments.json, device=device)


def _build_policy(arguments: argparse.Namespace, device: str) -> Policy:
    if arguments.policy == "cosmos":
        from capture.policies.cosmos.build import build_cosmos_policy
        from capture.policies.cosmos.config import DEFAULT_CONFIG_NAME

        return build_cosmos_policy(
            arguments.checkpoint,
            device=device,
            config_name=arguments.config_name or DEFAULT_CONFIG_NAME,
            num_denoising_steps_action=arguments.num_denoising_steps_action,
            chunk_size=arguments.chunk_size,
            num_open_loop_steps=arguments.num_open_loop_steps,
            dataset_stats_path=arguments.dataset_stats_path,
            t5_text_embeddings_path=arguments.t5_text_embeddings_path,
            t5_tokenizer=arguments.t5_tokenizer,
            t5_encoder=arguments.t5_encoder,
            vae_path=arguments.vae_path,
            dtype=arguments.dtype,
            query_frame=arguments.query_frame,
            visual_frame=arguments.visual_frame,
            text_frame=arguments.text_frame,
            prefer_s=arguments.prefer_s,
            prefer_call=arguments.prefer_call,
        )
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
    if arguments.policy == "cosmos":
        # The published scripts' proxy: one latent frame's mass over another's, both of self-attention. Named by the frames,
        # because the denominator's default frame is a blank picture and holds no language.
        above, below = arguments.visual_frame, arguments.text_frame
        command += ["--site", "self", "--group", f"{above}=frame:{above}", "--group", f"{below}=frame:{below}"]
        command += ["--ratio", f"{above}/{below}", "--denoise", arguments.prefer_call]
    return subprocess.run(command, check=False).returncode


if __name__ == "__main__":
    sys.exit(main())
