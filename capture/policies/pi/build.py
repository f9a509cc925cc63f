"""Build a pi policy from the options of the command line."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import torch

from vla_attention.capture.policies.hub import downloads, hub_version
from vla_attention.capture.policies.model_arguments import UNTRAINED, UNTRAINED_TINY, check_not_renamed
from vla_attention.capture.policies.pi.compiled import compile_steps
from vla_attention.capture.policies.pi.config import GEMMA_VARIANTS, GemmaConfig, find_config, find_variant
from vla_attention.capture.policies.pi.data_set_robot import untrained_robot
from vla_attention.capture.policies.pi.embedded import dummy_policy, embedded_policy
from vla_attention.capture.policies.pi.formats import detect_format, find_format
from vla_attention.capture.policies.pi.loading import CheckpointOptions, load_pi_policy
from vla_attention.capture.policies.pi.locate import find_checkpoint, find_tokenizer
from vla_attention.capture.policies.pi.policy import PiPolicy
from vla_attention.capture.policies.pi.shipped import SHIPPED
from vla_attention.capture.policies.precision import find_dtype
from vla_attention.capture.policies.robot import Robot, RobotData
from vla_attention.schemas.errors import BadArgument, listing

_UNTRAINED = {UNTRAINED: embedded_policy, UNTRAINED_TINY: dummy_policy}


def build_pi_policy(
    checkpoint: str,
    *,
    tokenizer: str | None,
    device: str,
    checkpoint_format: str | None = None,
    config_name: str | None = None,
    model_config: Path | None = None,
    discrete_state_input: bool = False,
    dtype: str | None = None,
    paligemma_variant: str | None = None,
    action_expert_variant: str | None = None,
    num_image_tokens: int | None = None,
    data: RobotData | None = None,
    robot: Robot | None = None,
    compiled: bool = False,
) -> PiPolicy:
    """Build the policy and check the options against it.

    `checkpoint` is a folder, a name on a hub, or one of the two untrained policies that come with the package:
    `untrained`, `untrained-tiny`. `compiled`: denoise steps through torch.compile. `data` and `robot`: see
    `load_pi_policy`. Raises `BadArgument` if a variant or the number of image tokens contradicts the policy, or if
    nothing can be compiled here.
    """
    wanted = {
        "--paligemma-variant": find_variant(paligemma_variant) if paligemma_variant else None,
        "--action-expert-variant": find_variant(action_expert_variant) if action_expert_variant else None,
    }
    options = CheckpointOptions(
        checkpoint_format=find_format(checkpoint_format) if checkpoint_format else None,
        config_name=config_name,
        model_config=model_config,
        discrete_state_input=discrete_state_input,
        dtype=find_dtype(dtype) if dtype else None,
    )
    if config_name is not None:
        find_config(config_name)  # an unknown name is reported before any download
    check_not_renamed(checkpoint)
    if checkpoint in _UNTRAINED:
        if dataclasses.replace(options, dtype=None) != CheckpointOptions() or options.dtype == torch.bfloat16:
            raise BadArgument(
                f"The policy '{checkpoint}' comes with the program, in float32; --checkpoint-format, --config-name, "
                "--model-config, --discrete-state-input and --dtype bfloat16 are for checkpoints."
            )
        policy = _UNTRAINED[checkpoint](device=device, robot=untrained_robot(data) if data else robot)
    else:
        path = SHIPPED[checkpoint] if checkpoint in SHIPPED else find_checkpoint(checkpoint)
        detect_format(path, options.checkpoint_format)  # a folder without a checkpoint is reported first
        tokenizer_path = find_tokenizer(path, tokenizer)
        policy = load_pi_policy(path, tokenizer_path, options=options, device=device, data=data, robot=robot)
        policy.source = dataclasses.replace(policy.source, downloads=downloads(path, tokenizer_path))
        version = hub_version(path)
        if version is not None and not Path(checkpoint).expanduser().exists():
            # A name on the hub stands for other files tomorrow; with the commit it does not.
            policy.source = dataclasses.replace(policy.source, checkpoint=str(version))
        if checkpoint in SHIPPED:
            # Where the package is installed differs between machines; its name does not.
            policy.source = dataclasses.replace(policy.source, checkpoint=checkpoint)
    config = policy.model.config
    for option, given, actual in (
        ("--paligemma-variant", wanted["--paligemma-variant"], config.paligemma),
        ("--action-expert-variant", wanted["--action-expert-variant"], config.action_expert),
    ):
        if given is not None and given != actual:
            raise BadArgument(
                f"{option} contradicts the policy '{checkpoint}', whose part has {_sizes(actual)}, not "
                f"{_sizes(given)}; leave the option out."
            )
    if num_image_tokens is not None and num_image_tokens != config.siglip.num_tokens:
        raise BadArgument(
            f"--num-image-tokens {num_image_tokens} contradicts the layout: each of the cameras "
            f"{listing(config.cameras)} has {config.siglip.num_tokens} keys; leave the option out."
        )
    if compiled:
        compile_steps(policy.model)
    return policy


def _sizes(config: GemmaConfig) -> str:
    name = next((name for name, variant in GEMMA_VARIANTS.items() if variant == config), "its own sizes")
    return f"width {config.width} and depth {config.depth} ({name})"
