"""The entry of the pi family: pi0 and pi0.5, from openpi and from LeRobot."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vla_attention.capture.environments.episode_protocol import CAMERAS, LEROBOT, OPENPI
from vla_attention.capture.environments.suites import STANDARD_SUITES
from vla_attention.capture.policies.family import PolicyFamily, PublishedScript
from vla_attention.capture.policies.model_arguments import UNTRAINED_POLICIES, add_model_arguments
from vla_attention.capture.policies.robot import NONE, Robot, read_camera_choices
from vla_attention.schemas.jsonable import from_json

if TYPE_CHECKING:
    from vla_attention.capture.policies.pi.policy import PiPolicy
    from vla_attention.schemas.stores.store_format import PolicyIdentity

#: A small pi0.5 for the suite `cubes`; `docs/cubes.md` says how it was trained and what it can do.
CUBES_POLICY = "pi05_cubes"
SHIPPED: dict[str, Path] = {CUBES_POLICY: Path(__file__).parent / CUBES_POLICY}

_OF_LIBERO = (
    "gs://openpi-assets/checkpoints/pi05_libero",
    "lerobot/pi05_libero_finetuned",
    "lerobot/pi05_libero_finetuned_v044",
)

_EXAMPLES = """\
  vla-attention capture pi                                           a small trained policy and its tasks, docs/cubes.md
  vla-attention capture pi --checkpoint ~/.cache/openpi/openpi-assets/checkpoints/pi05_libero \\
      --task-suite libero_10 --num-episodes 5 --output-dir results/attention_ratio
  vla-attention capture pi --checkpoint lerobot/pi05_libero_finetuned --tokenizer PATH --task-suite libero_10
  vla-attention capture pi --task-suite libero_10 --task-id 0 --num-episodes 1 --max-steps 40 --libero-assets PATH
"""


def _add_arguments(parser: argparse.ArgumentParser) -> None:
    model = add_model_arguments(
        parser,
        checkpoint="checkpoint folder of openpi (JAX or PyTorch) or LeRobot, ORG/NAME on the Hugging Face hub, or "
        f"gs://...; '{CUBES_POLICY}' is a small trained policy that comes with the tool",
        default=CUBES_POLICY,
        config_name="openpi's name for the configuration (pi05_libero, pi0_libero ...)",
        dtype_default="what a LeRobot checkpoint states, else float32",
    )
    model.add_argument(
        "--checkpoint-format",
        metavar="NAME",
        help="openpi_torch, openpi_jax or lerobot (default: recognised from the files)",
    )
    model.add_argument(
        "--model-config",
        type=Path,
        metavar="PATH",
        help="JSON file with the sizes that a checkpoint does not state (default: a case.json beside it, if any)",
    )
    model.add_argument(
        "--discrete-state-input", action="store_true", help="openpi's pi0.5 trained with the state in its prompt"
    )
    model.add_argument(
        "--norm-stats",
        type=Path,
        metavar="FILE",
        help="openpi's norm_stats.json of the training (default: the one in the checkpoint's assets)",
    )
    model.add_argument(
        "--asset-id", metavar="NAME", help="which statistics, where the checkpoint's assets have several"
    )
    model.add_argument(
        "--camera",
        action="append",
        default=[],
        metavar="POLICY=PICTURE",
        help=f"what one camera of the policy sees: {' or '.join(CAMERAS)} of the simulators, or a column of a "
        f"data set; {NONE} leaves it black and masked (default: that of the checkpoint's evaluation, or the "
        "column of the same name)",
    )
    model.add_argument("--tokenizer", metavar="PATH", help="sentencepiece model of the policy's language model")
    model.add_argument("--paligemma-variant", metavar="NAME", help="checked against the checkpoint (gemma_2b ...)")
    model.add_argument(
        "--action-expert-variant", metavar="NAME", help="checked against the checkpoint (gemma_300m ...)"
    )
    model.add_argument(
        "--compile",
        action="store_true",
        help="denoise steps through torch.compile, as CUDA graphs on a GPU; the first call takes minutes",
    )
    model.add_argument("--num-image-tokens", type=int, metavar="N", help="checked against the policy's layout")


def _build(arguments: argparse.Namespace, device: str) -> PiPolicy:
    from vla_attention.capture.policies.pi.loading import build_pi_policy

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
        norm_stats=arguments.norm_stats,
        asset_id=arguments.asset_id,
        cameras=read_camera_choices(arguments.camera, CAMERAS),
        data=getattr(arguments, "robot_data", None),
        robot=getattr(arguments, "robot", None),
        compiled=getattr(arguments, "compile", False),
    )


def _check_files(arguments: argparse.Namespace) -> None:
    from vla_attention.capture.policies.pi.loading import check_pi_files

    check_pi_files(
        arguments.checkpoint,
        tokenizer=arguments.tokenizer,
        checkpoint_format=arguments.checkpoint_format,
        config_name=arguments.config_name,
        model_config=arguments.model_config,
        norm_stats=arguments.norm_stats,
        asset_id=arguments.asset_id,
    )


def _rebuild(identity: PolicyIdentity) -> dict[str, Any]:
    facts = identity.config
    if "robot" in facts:
        same: dict[str, Any] = {"robot": from_json(Robot, facts["robot"])}
    else:
        sources = {camera.name: camera.source for camera in identity.cameras}
        slots = facts.get("config", {}).get("cameras", ())
        same = {"camera": [f"{name}={sources.get(name, NONE)}" for name in slots]}
    same |= {name: Path(facts[name]) for name in ("model_config", "norm_stats") if name in facts}
    same |= {name: facts[name] for name in ("asset_id",) if name in facts}
    if "denoise_steps" in facts:
        same["compile"] = True
    if identity.checkpoint_format == "seeded":
        return {"checkpoint": identity.name, **same}
    settings = {"checkpoint": identity.checkpoint, "dtype": identity.config["dtype"], **same}
    if identity.checkpoint_format in ("openpi_torch", "openpi_jax", "lerobot"):
        settings["checkpoint_format"] = identity.checkpoint_format
    if identity.checkpoint_format.startswith("openpi"):
        settings["discrete_state_input"] = identity.config["config"].get("discrete_state_input", False)
    if "config_name" in identity.config:
        settings["config_name"] = identity.config["config_name"]
    return settings


FAMILY = PolicyFamily(
    name="pi",
    title="pi0 or pi0.5",
    description="Record a pi0 or pi0.5 policy.",
    examples=_EXAMPLES,
    add_arguments=_add_arguments,
    build=_build,
    store_prefix="",
    replan_default="5 for openpi, n_action_steps for LeRobot",
    protocols=(OPENPI, LEROBOT),
    layers_note="; also the published scripts' numbers 18..35 (25 = block 7)",
    built_in=(*SHIPPED, *UNTRAINED_POLICIES),
    default_suite="cubes",
    published=PublishedScript(
        program="evaluate-attention-ratio",
        checkpoint="~/.cache/openpi/openpi-assets/checkpoints/pi05_libero",
        layers=(25, 26, 27),
        variables={"PROTOCOL": "--protocol"},
    ),
    trained_on={CUBES_POLICY: ("cubes",)} | dict.fromkeys(_OF_LIBERO, STANDARD_SUITES),
    kinds=("pi0", "pi05"),
    reads_data_sets=True,
    rebuild=_rebuild,
    check_files=_check_files,
)
