"""The entry of the Cosmos family: Cosmos Policy."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING, Any

from vla_attention.capture.environments.episode_protocol import EvaluationProtocol
from vla_attention.capture.environments.suites import STANDARD_SUITES
from vla_attention.capture.policies.family import PolicyFamily, PublishedScript
from vla_attention.capture.policies.model_arguments import UNTRAINED_POLICIES, add_model_arguments
from vla_attention.schemas.errors import BadArgument

if TYPE_CHECKING:
    from vla_attention.capture.policies.cosmos.policy import CosmosPolicy
    from vla_attention.schemas.stores.store_format import PolicyIdentity

# In its deterministic mode, the default, it seeds everything with 0 before every step of an episode. No step draws a
# random number, so every reset begins with that seed too.
COSMOS = EvaluationProtocol("cosmos", image_size=256, seeding="always 0", default_seed=7)

CHECKPOINT = "nvidia/Cosmos-Policy-LIBERO-Predict2-2B"

_EXAMPLES = f"""\
  vla-attention capture cosmos                                         untrained policy, built-in tasks
  vla-attention capture cosmos --ckpt-path {CHECKPOINT} --task-suite libero_10
"""


def _add_arguments(parser: argparse.ArgumentParser) -> None:
    model = add_model_arguments(
        parser,
        checkpoint_options=("--ckpt-path", "--checkpoint"),
        checkpoint="checkpoint folder, ORG/NAME on the Hugging Face hub, or a file of weights",
        config_name="the reference's name for the configuration",
        dtype_default="bfloat16 on a GPU, float32 on a CPU",
    )
    model.add_argument("--dataset-stats-path", metavar="PATH", help="statistics (default: the checkpoint's own)")
    model.add_argument(
        "--t5-text-embeddings-path", metavar="PATH", help="precomputed embeddings (default: the checkpoint's own)"
    )
    model.add_argument(
        "--t5-tokenizer", metavar="PATH", help="T5's spiece.model: makes words of the instruction selectable"
    )
    model.add_argument(
        "--t5-encoder", metavar="PATH", help="T5 model folder, for instructions without a precomputed embedding"
    )
    model.add_argument("--vae-path", metavar="PATH", help="image encoder's weights (default: the checkpoint's own)")
    model.add_argument("--num-denoising-steps-action", type=int, metavar="N", help="denoise steps (default: 5)")
    model.add_argument("--chunk-size", type=int, metavar="N", help="actions of a call (default: 16)")
    model.add_argument(
        "--num-open-loop-steps", type=int, metavar="N", help="actions executed per call (default: the chunk)"
    )
    model.add_argument("--compile", action="store_true", help=argparse.SUPPRESS)  # refused in `_build`
    frames = parser.add_argument_group("frames of the published proxy (the store keeps all of them)")
    frames.add_argument(
        "--query-frame", default="action", metavar="NAME", help="whose queries are recorded (default: action)"
    )
    frames.add_argument(
        "--visual-frame", default="curr_last", metavar="NAME", help="numerator frame (default: curr_last)"
    )
    frames.add_argument(
        "--text-frame", default="frame0", metavar="NAME", help="denominator frame (default: frame0, a blank one)"
    )
    frames.add_argument(
        "--prefer-S", dest="prefer_s", type=int, metavar="N", help="length that the analysed call must have"
    )
    frames.add_argument("--prefer-call", default="last", metavar="NAME", help="last (default) or first of those calls")


def _build(arguments: argparse.Namespace, device: str) -> CosmosPolicy:
    from vla_attention.capture.policies.cosmos.config import DEFAULT_CONFIG_NAME
    from vla_attention.capture.policies.cosmos.loading import build_cosmos_policy

    if getattr(arguments, "compile", False):
        raise BadArgument("Cannot use --compile with a Cosmos policy: so far only pi models have it; leave it out.")
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


def _analysis_arguments(arguments: argparse.Namespace) -> list[str]:
    """Return the published scripts' proxy: the mass of one latent frame over that of another, of self-attention.

    The groups carry the frames' names, because the denominator's default frame is a blank picture without language.
    """
    above, below = arguments.visual_frame, arguments.text_frame
    groups = ["--group", f"{above}=frame:{above}", "--group", f"{below}=frame:{below}"]
    return ["--site", "self", *groups, "--ratio", f"{above}/{below}", "--denoise", arguments.prefer_call]


def _rebuild(identity: PolicyIdentity) -> dict[str, Any]:
    facts = {
        "query_frame": identity.config["query_frame"],
        "num_denoising_steps_action": identity.config["config"]["sampler"]["num_steps"],
        "chunk_size": identity.action_horizon,
    }
    if identity.checkpoint_format == "seeded":
        return {"checkpoint": identity.name, **facts}
    return {
        "checkpoint": identity.checkpoint,
        "config_name": identity.config["configuration"],
        "dtype": identity.config["dtype"],
        **facts,
    }


def _check_files(arguments: argparse.Namespace) -> None:
    from pathlib import Path

    from vla_attention.capture.policies.cosmos.locate import (
        EMBEDDINGS_NAME,
        STATISTICS_NAME,
        find_beside,
        find_checkpoint,
        find_vae,
        find_weights,
    )
    from vla_attention.capture.policies.cosmos.preprocess import read_statistics
    from vla_attention.capture.policies.cosmos.t5_pickle import read_embeddings
    from vla_attention.capture.policies.cosmos.tensor_files import read_tensors
    from vla_attention.capture.policies.hub import split_hub_name

    name = arguments.checkpoint
    on_hub = split_hub_name(name) is not None and not Path(name).expanduser().exists()
    if name not in UNTRAINED_POLICIES and not on_hub:
        folder = find_checkpoint(name)
        weights = find_weights(folder)
        read_statistics(find_beside(folder, arguments.dataset_stats_path, STATISTICS_NAME))
        read_embeddings(find_beside(folder, arguments.t5_text_embeddings_path, EMBEDDINGS_NAME))
        for file in (weights, find_vae(folder, arguments.vae_path)):
            read_tensors(file)  # mapped into memory: the numbers are not read


FAMILY = PolicyFamily(
    name="cosmos",
    title="Cosmos Policy",
    description="Record a Cosmos Policy: self-attention over latent frames, cross-attention over text.",
    examples=_EXAMPLES,
    add_arguments=_add_arguments,
    build=_build,
    store_prefix="cosmos_",
    replan_default="--num-open-loop-steps",
    protocols=(COSMOS,),
    seed_of="seed of the noise; the simulator's is 0, as published",
    built_in=UNTRAINED_POLICIES,
    analysis_arguments=_analysis_arguments,
    published=PublishedScript(
        program="evaluate-attention-ratio-cosmos",
        checkpoint=CHECKPOINT,
        layers=(25, 26, 27),
        variables={"QUERY_FRAME": "--query-frame", "VISUAL_FRAME": "--visual-frame", "TEXT_FRAME": "--text-frame"},
    ),
    trained_on={CHECKPOINT: STANDARD_SUITES},
    rebuild=_rebuild,
    check_files=_check_files,
)
