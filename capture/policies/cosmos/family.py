"""The entry of the Cosmos family: Cosmos Policy."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Literal

from vla_attention.capture.environments.episode_protocol import EvaluationProtocol
from vla_attention.capture.environments.suites import STANDARD_SUITES
from vla_attention.capture.policies.cosmos.config import DEFAULT_CONFIG_NAME, CosmosConfig
from vla_attention.capture.policies.family import (
    UNTRAINED_POLICIES,
    ModelSettings,
    PolicyFamily,
    PublishedScript,
    checkpoint_option,
)
from vla_attention.schemas.options import option

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


@dataclass(frozen=True)
class CosmosSettings(ModelSettings):
    """Which Cosmos Policy is loaded; None takes what the checkpoint or the named configuration has.

    dtype: None takes bfloat16 on a GPU, like the reference, and float32 on a CPU. image_size: pixels of one side, for a
    checkpoint with another size than the published one.
    """

    checkpoint: str = checkpoint_option(
        "checkpoint folder, ORG/NAME on the Hugging Face hub, or a file of weights",
        name="ckpt-path",
        also="checkpoint",
        dest="checkpoint",
    )
    config_name: str = option("the reference's name for sizes, frames and noise levels", DEFAULT_CONFIG_NAME)
    dtype: Literal["float32", "bfloat16"] | None = option(
        "precision (default: bfloat16 on a GPU, float32 on a CPU)", None
    )
    dataset_stats_path: str | None = option("statistics (default: the checkpoint's own)", None, metavar="PATH")
    t5_text_embeddings_path: str | None = option(
        "precomputed embeddings (default: the checkpoint's own)", None, metavar="PATH"
    )
    t5_tokenizer: str | None = option(
        "T5's spiece.model: makes words of the instruction selectable", None, metavar="PATH"
    )
    t5_encoder: str | None = option(
        "T5 model folder, for instructions without a precomputed embedding", None, metavar="PATH"
    )
    vae_path: str | None = option("image encoder's weights (default: the checkpoint's own)", None, metavar="PATH")
    num_denoising_steps_action: int | None = option("denoise steps (default: 5)", None)
    chunk_size: int | None = option("actions of a call (default: 16)", None)
    num_open_loop_steps: int | None = option("actions executed per call (default: the chunk)", None)
    query_frame: str = option(
        "whose queries are recorded (default: %(default)s)",
        "action",
        group="frames of the published proxy (the store keeps all of them)",
    )
    visual_frame: str = option("numerator frame (default: %(default)s)", "curr_last")
    text_frame: str = option("denominator frame (default: %(default)s, a blank one)", "frame0")
    prefer_s: int | None = option("length that the analysed call must have", None, name="prefer-S", dest="prefer_s")
    prefer_call: Literal["last", "first"] = option("last (default) or first of those calls", "last")
    image_size: int | None = None

    def apply(self, config: CosmosConfig) -> CosmosConfig:
        """Return the configuration with the user's choices."""
        changes: dict[str, Any] = {}
        if self.num_denoising_steps_action is not None:
            changes["sampler"] = replace(config.sampler, num_steps=self.num_denoising_steps_action)
        if self.chunk_size is not None:
            changes["chunk_size"] = self.chunk_size
        if self.image_size is not None:
            changes["image_size"] = self.image_size
        return replace(config, **changes)

    def open_loop_steps(self, config: CosmosConfig) -> int:
        """Return how many actions of a chunk are executed; by default all of them."""
        return config.chunk_size if self.num_open_loop_steps is None else self.num_open_loop_steps

    def build(self, device: str) -> CosmosPolicy:
        """Load the policy; see `build_cosmos_policy`."""
        from vla_attention.capture.policies.cosmos.loading import build_cosmos_policy

        return build_cosmos_policy(self, device)

    def analysis_arguments(self) -> list[str]:
        """Return the published scripts' proxy: the mass of one latent frame over that of another, of self-attention.

        The groups carry the frames' names, because the denominator's default frame is a blank picture without language.
        """
        above, below = self.visual_frame, self.text_frame
        groups = ["--group", f"{above}=frame:{above}", "--group", f"{below}=frame:{below}"]
        return ["--site", "self", *groups, "--ratio", f"{above}/{below}", "--denoise", self.prefer_call]

    @staticmethod
    def of_store(identity: PolicyIdentity) -> dict[str, Any]:
        """Return the settings with which `build` makes the policy of a store again."""
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

    def check_files(self) -> None:
        """See `check_cosmos_files`."""
        from vla_attention.capture.policies.cosmos.loading import check_cosmos_files

        check_cosmos_files(self)


FAMILY = PolicyFamily(
    name="cosmos",
    title="Cosmos Policy",
    description="Record a Cosmos Policy: self-attention over latent frames, cross-attention over text.",
    examples=_EXAMPLES,
    settings=CosmosSettings,
    store_prefix="cosmos_",
    replan_default="--num-open-loop-steps",
    protocols=(COSMOS,),
    seed_of="seed of the noise; the simulator's is 0, as published",
    built_in=UNTRAINED_POLICIES,
    published=PublishedScript(
        program="evaluate-attention-ratio-cosmos",
        checkpoint=CHECKPOINT,
        layers=(25, 26, 27),
        variables=("QUERY_FRAME", "VISUAL_FRAME", "TEXT_FRAME"),
    ),
    trained_on={CHECKPOINT: STANDARD_SUITES},
)
