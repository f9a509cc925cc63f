"""The entry of the pi family: pi0 and pi0.5, from openpi and from LeRobot."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from vla_attention.capture.environments.episode_protocol import CAMERAS, LEROBOT, OPENPI
from vla_attention.capture.environments.suites import STANDARD_SUITES
from vla_attention.capture.policies.family import (
    UNTRAINED_POLICIES,
    ModelSettings,
    PolicyFamily,
    PublishedScript,
    checkpoint_option,
)
from vla_attention.capture.policies.pi.formats import CheckpointFormat
from vla_attention.capture.policies.robot import NONE, Robot, RobotData
from vla_attention.schemas.jsonable import from_json
from vla_attention.schemas.options import option

if TYPE_CHECKING:
    from vla_attention.capture.policies.pi.policy import PiPolicy
    from vla_attention.schemas.stores.store_format import PolicyIdentity

#: A small pi0.5 for the suite `cubes`; `docs/validation.md` says how it was trained and what it can do.
CUBES_POLICY = "pi05_cubes"
SHIPPED: dict[str, Path] = {CUBES_POLICY: Path(__file__).parent / CUBES_POLICY}

_OF_LIBERO = (
    "gs://openpi-assets/checkpoints/pi05_libero",
    "lerobot/pi05_libero_finetuned",
    "lerobot/pi05_libero_finetuned_v044",
)

_EXAMPLES = """\
  vla-attention capture pi                                      a small trained policy and its tasks, docs/validation.md
  vla-attention capture pi --checkpoint ~/.cache/openpi/openpi-assets/checkpoints/pi05_libero \\
      --task-suite libero_10 --num-episodes 5 --output-dir results/attention_ratio
  vla-attention capture pi --checkpoint lerobot/pi05_libero_finetuned --tokenizer PATH --task-suite libero_10
  vla-attention capture pi --task-suite libero_10 --task-id 0 --num-episodes 1 --max-steps 40 --libero-assets PATH
"""


@dataclass(frozen=True)
class PiSettings(ModelSettings):
    """Which pi policy is loaded; None takes what the checkpoint has or says.

    robot_data: the data set that the policy is called on; robot: what was found for it before. With neither it acts in
    the simulators.
    """

    checkpoint: str = checkpoint_option(
        "checkpoint folder of openpi (JAX or PyTorch) or LeRobot, ORG/NAME on the Hugging Face hub, or gs://...; "
        f"'{CUBES_POLICY}' is a small trained policy that comes with the tool",
        CUBES_POLICY,
    )
    config_name: str | None = option("openpi's name for the configuration (pi05_libero, pi0_libero ...)", None)
    dtype: Literal["float32", "bfloat16"] | None = option(
        "precision (default: what a LeRobot checkpoint states, else float32)", None
    )
    checkpoint_format: CheckpointFormat | None = option("format (default: recognised from the files)", None)
    model_config: Path | None = option(
        "JSON file with the sizes that a checkpoint does not state (default: a case.json beside it, if any)", None
    )
    discrete_state_input: bool = option("openpi's pi0.5 trained with the state in its prompt", False)
    norm_stats: Path | None = option(
        "openpi's norm_stats.json of the training, or for a LeRobot checkpoint its data set's meta/stats.json "
        "(default: those of the checkpoint)",
        None,
    )
    asset_id: str | None = option("which statistics, where the checkpoint's assets have several", None)
    compile: bool = option(
        "run the denoise steps as one graph of torch.compile: the first call takes minutes, the others less time on a "
        "GPU; calls are then made one by one",
        False,
    )
    camera: tuple[str, ...] = option(
        f"what one camera of the policy sees: {' or '.join(CAMERAS)} of the simulators, or a column of a data set; "
        f"{NONE} leaves it black and masked (default: that of the checkpoint's evaluation, or the column of the same "
        "name)",
        (),
        action="append",
        metavar="POLICY=PICTURE",
    )
    tokenizer: str | None = option("sentencepiece model of the policy's language model", None, metavar="PATH")
    paligemma_variant: str | None = option("checked against the checkpoint (gemma_2b ...)", None)
    action_expert_variant: str | None = option("checked against the checkpoint (gemma_300m ...)", None)
    num_image_tokens: int | None = option("checked against the policy's layout", None)
    robot_data: RobotData | None = None
    robot: Robot | None = None

    def stored(self) -> dict[str, str]:
        """Return the files and names that a rerun needs, for a store's root."""
        given = {"model_config": self.model_config, "norm_stats": self.norm_stats, "asset_id": self.asset_id}
        return {name: str(value) for name, value in given.items() if value is not None}

    def build(self, device: str) -> PiPolicy:
        """Load the policy; see `build_pi_policy`."""
        from vla_attention.capture.policies.pi.loading import build_pi_policy

        policy = build_pi_policy(self, device)
        if self.compile:
            policy.compile_steps()
        return policy

    def check_files(self) -> None:
        """See `check_pi_files`."""
        from vla_attention.capture.policies.pi.loading import check_pi_files

        check_pi_files(self)

    @staticmethod
    def of_store(identity: PolicyIdentity) -> dict[str, Any]:
        """Return the settings with which `build` makes the policy of a store again."""
        facts = identity.config
        if "robot" in facts:
            same: dict[str, Any] = {"robot": from_json(Robot, facts["robot"])}
        else:
            sources = {camera.name: camera.source for camera in identity.cameras}
            slots = facts.get("config", {}).get("cameras", ())
            same = {"camera": [f"{name}={sources.get(name, NONE)}" for name in slots]}
        same |= {name: Path(facts[name]) for name in ("model_config", "norm_stats") if name in facts}
        same |= {name: facts[name] for name in ("asset_id", "config_name") if name in facts}
        same["compile"] = "compiled" in facts
        if identity.checkpoint_format == "seeded":
            return {"checkpoint": identity.name, **same}
        if identity.checkpoint_format.startswith("openpi"):
            same["discrete_state_input"] = facts["config"].get("discrete_state_input", False)
        return {
            "checkpoint": identity.checkpoint,
            "checkpoint_format": identity.checkpoint_format,
            "dtype": facts["dtype"],
            **same,
        }


FAMILY = PolicyFamily(
    name="pi",
    title="pi0 or pi0.5",
    description="Record a pi0 or pi0.5 policy.",
    examples=_EXAMPLES,
    settings=PiSettings,
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
        variables=("PROTOCOL",),
    ),
    trained_on={CUBES_POLICY: ("cubes",)} | dict.fromkeys(_OF_LIBERO, STANDARD_SUITES),
    kinds=("pi0", "pi05"),
    reads_data_sets=True,
)
