"""From command-line arguments to the policy that they name."""

from __future__ import annotations

import argparse

from vla_attention.capture.policies.policy import Policy


def build_policy(arguments: argparse.Namespace, device: str) -> Policy:
    """Build the policy of `vla-capture pi` or `vla-capture cosmos` on a device."""
    if arguments.policy == "cosmos":
        from vla_attention.capture.policies.cosmos.build import build_cosmos_policy
        from vla_attention.capture.policies.cosmos.config import DEFAULT_CONFIG_NAME

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
    from vla_attention.capture.policies.pi.build import build_pi_policy

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
