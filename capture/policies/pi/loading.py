"""Load a pi model, or a whole policy, from a checkpoint folder of any format or the options of the command line."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path

import torch

from vla_attention.capture.environments.episode_protocol import CAMERAS
from vla_attention.capture.policies.checkpoints import UnsupportedCheckpoint, read_json_object
from vla_attention.capture.policies.family import UNTRAINED, UNTRAINED_TINY
from vla_attention.capture.policies.identity import PolicySource
from vla_attention.capture.policies.pi.config import (
    CAMERA_SLOTS,
    GEMMA_VARIANTS,
    NAMED_CONFIGS,
    GemmaConfig,
    PiConfig,
    find_config,
    find_variant,
)
from vla_attention.capture.policies.pi.data_set_robot import lerobot_robot, openpi_robot
from vla_attention.capture.policies.pi.embedded import dummy_policy, embedded_policy
from vla_attention.capture.policies.pi.family import SHIPPED, PiSettings
from vla_attention.capture.policies.pi.formats import CheckpointFormat, detect_format
from vla_attention.capture.policies.pi.lerobot import lerobot_arm, lerobot_model, lerobot_processing
from vla_attention.capture.policies.pi.lerobot_config import read_lerobot_config
from vla_attention.capture.policies.pi.lerobot_pipeline import read_lerobot_pipeline
from vla_attention.capture.policies.pi.locate import find_checkpoint, find_tokenizer
from vla_attention.capture.policies.pi.model import PiModel
from vla_attention.capture.policies.pi.openpi_jax import OpenLeaf, list_leaves, load_openpi_jax
from vla_attention.capture.policies.pi.openpi_torch import load_safetensors, open_tensors
from vla_attention.capture.policies.pi.policy import PiPolicy
from vla_attention.capture.policies.pi.preprocess import RELATIVE_ACTIONS, find_norm_stats, read_norm_stats
from vla_attention.capture.policies.pi.processing import (
    CAMERA_OF_SLOT,
    Processing,
    openpi_arm,
    openpi_processing,
    simulated_arm,
    simulator_cameras,
)
from vla_attention.capture.policies.pi.sizes import is_pi05, stated_config
from vla_attention.capture.policies.pi.stated_sizes import (
    CASE_FILE,
    CONFIG_FILE,
    read_config,
    stated_name,
    states_sizes,
)
from vla_attention.capture.policies.pi.tokenizer import PromptTokenizer
from vla_attention.capture.policies.robot import read_camera_choices
from vla_attention.capture.policies.weights import DTYPES
from vla_attention.schemas.errors import BadArgument, listing
from vla_attention.schemas.hub import downloads, lasting_name, would_be_fetched


def load_pi_model(
    folder: Path,
    config: PiConfig,
    *,
    checkpoint_format: CheckpointFormat | None = None,
    dtype: torch.dtype = torch.float32,
    device: str | torch.device = "cpu",
) -> PiModel:
    """Load the model of a checkpoint folder; its tensors must be those of the configuration."""
    load = load_openpi_jax if detect_format(folder, checkpoint_format) == "openpi_jax" else load_safetensors
    return load(folder, config, dtype, device)


#: The folder of openpi's statistics of DROID, in `assets/`.
DROID_ASSET = "droid"


#: openpi's configurations of pi0 in LIBERO, whose data have actions relative to the state.
_OF_RELATIVE_ACTIONS = ("pi0_libero", "pi0_libero_low_mem_finetune")


@dataclass(frozen=True)
class ChosenConfig:
    """The configuration that a checkpoint is loaded with.

    config: None for what a LeRobot checkpoint states itself. source: where it is from, in words. name: openpi's for it,
    empty without one.
    """

    config: PiConfig | None
    source: str
    name: str = ""

    @classmethod
    def named(cls, name: str, why: str = "") -> ChosenConfig:
        """Openpi's configuration of that name."""
        return cls(find_config(name), f"openpi's {name}{why}", name)


def choose_config(
    folder: Path, found: CheckpointFormat, settings: PiSettings, *, of_data_set: bool = False
) -> ChosenConfig:
    """Return the configuration of the settings, of a case.json beside the checkpoint, or that the checkpoint implies.

    of_data_set: the policy is for the robot of a data set, which the name of the checkpoint's statistics may tell.

    Raises:
        BadArgument: settings contradict each other or the format.
        UnsupportedCheckpoint: nothing states the configuration.
    """
    for is_wrong, said in (
        (settings.config_name and settings.model_config, "Give --config-name or --model-config, not both."),
        (settings.norm_stats and settings.asset_id, "Give --norm-stats or --asset-id, not both."),
        (
            found == "lerobot" and (settings.config_name or settings.discrete_state_input),
            "A LeRobot checkpoint states its configuration in config.json; leave --config-name and "
            "--discrete-state-input out.",
        ),
        (
            found == "lerobot" and settings.asset_id,
            "A LeRobot checkpoint has its statistics in its saved pipelines (policy_preprocessor.json); leave "
            "--asset-id out, or give those of its data set with --norm-stats FILE.",
        ),
    ):
        if is_wrong:
            raise BadArgument(said)
    if settings.config_name is not None:
        return ChosenConfig.named(settings.config_name)
    if settings.model_config is not None:
        path = settings.model_config.expanduser()
        return ChosenConfig(read_config(path), str(path))
    beside = folder.absolute().parent / CASE_FILE
    if beside.is_file():
        return ChosenConfig(read_config(beside), f"{CASE_FILE} beside the checkpoint")
    if found == "openpi_torch" and states_sizes(folder / CONFIG_FILE):
        return ChosenConfig(read_config(folder / CONFIG_FILE), CONFIG_FILE)
    if found == "lerobot":
        return ChosenConfig(None, CONFIG_FILE)
    has_pi05 = _is_pi05(folder, found)  # whatever else it may be comes first
    kind = "pi05" if has_pi05 else "pi0"
    of_statistics = [settings.asset_id] if settings.asset_id else list(find_norm_stats(folder))
    if of_data_set and of_statistics == [DROID_ASSET]:
        return ChosenConfig.named(f"{kind}_droid", f" (its statistics are those of '{DROID_ASSET}')")
    if found == "openpi_jax":
        return ChosenConfig.named(f"{kind}_libero", " (not stated by the checkpoint)")
    if not (folder / CONFIG_FILE).is_file():
        raise UnsupportedCheckpoint(
            f"'{folder}' has no {CONFIG_FILE}, as openpi's train_pytorch.py leaves it, so that nothing states its "
            f"heads and the actions of a call. Give --config-name NAME (openpi's {listing(NAMED_CONFIGS)}), or "
            f"--model-config FILE, a file like {CASE_FILE} (docs/my-checkpoint.md)."
        )
    return ChosenConfig(stated_config(read_json_object(folder / CONFIG_FILE), pi05=has_pi05), CONFIG_FILE)


def _is_pi05(folder: Path, found: CheckpointFormat) -> bool:
    """Whether a checkpoint is pi0.5's; of openpi's JAX format, one without a projection of the state."""
    if found == "openpi_jax":
        return not any(leaf.path.startswith("state_proj/") for leaf in list_leaves(folder / "params"))
    with open_tensors(folder) as tensors:
        return is_pi05(tensors.held)


_UNTRAINED = {UNTRAINED: embedded_policy, UNTRAINED_TINY: dummy_policy}


def build_pi_policy(settings: PiSettings, device: str) -> PiPolicy:
    """Build the policy and check the settings against it.

    Raises `BadArgument` if a variant or the number of image tokens contradicts the policy.
    """
    checkpoint = settings.checkpoint
    named = (settings.paligemma_variant, settings.action_expert_variant)
    variants = [find_variant(name) if name else None for name in named]
    if settings.config_name is not None:
        find_config(settings.config_name)  # an unknown name is reported before any download
    policy = (_build_untrained if checkpoint in _UNTRAINED else load_pi_policy)(settings, device)
    config = policy.model.config
    for option, given, actual in (
        ("--paligemma-variant", variants[0], config.paligemma),
        ("--action-expert-variant", variants[1], config.action_expert),
    ):
        if given is not None and given != actual:
            raise BadArgument(
                f"{option} contradicts the policy '{checkpoint}', whose part has {_sizes(actual)}, not "
                f"{_sizes(given)}; leave the option out."
            )
    if settings.num_image_tokens not in (None, config.siglip.num_tokens):
        raise BadArgument(
            f"--num-image-tokens {settings.num_image_tokens} contradicts the layout: each of the cameras "
            f"{listing(config.cameras)} has {config.siglip.num_tokens} keys; leave the option out."
        )
    return policy


def _chosen_cameras(settings: PiSettings) -> dict[str, str]:
    """Return policy camera -> camera of the simulators, of `--camera`; a data set's columns are chosen elsewhere."""
    cameras = {} if settings.robot_data is not None else read_camera_choices(settings.camera, CAMERAS)
    if cameras and settings.robot is not None:
        raise BadArgument("Cannot use --camera: the pictures of a data set's store are chosen already; leave it out.")
    return cameras


def _build_untrained(settings: PiSettings, device: str) -> PiPolicy:
    settings.refuse_for_untrained(
        "checkpoint_format", "config_name", "model_config", "discrete_state_input", "norm_stats", "asset_id"
    )
    robot, cameras = settings.robot, _chosen_cameras(settings)
    if settings.robot_data is not None:
        robot = openpi_robot(settings.robot_data, None)
    elif cameras:
        robot = simulated_arm(simulator_cameras(CAMERA_SLOTS, CAMERA_OF_SLOT, cameras))
    return _UNTRAINED[settings.checkpoint](device=device, robot=robot)


@dataclass(frozen=True)
class _Planned:
    """A policy of a checkpoint but for its weights."""

    folder: Path
    found: CheckpointFormat
    config: PiConfig
    dtype: torch.dtype
    tokenizer: PromptTokenizer
    processing: Processing
    source: PolicySource


def _plan(settings: PiSettings) -> _Planned:
    """Read everything of a checkpoint that is small, before the minutes for loading its weights."""
    name, data, robot, cameras = settings.checkpoint, settings.robot_data, settings.robot, _chosen_cameras(settings)
    folder = SHIPPED[name] if name in SHIPPED else find_checkpoint(name)
    found = detect_format(folder, settings.checkpoint_format)
    chosen = choose_config(folder, found, settings, of_data_set=bool(data or robot))
    dtype: str = settings.dtype or "float32"
    if found == "lerobot":
        stated = read_lerobot_config(folder)
        pipeline = read_lerobot_pipeline(folder, stated, settings.norm_stats)
        dtype = settings.dtype or stated.dtype
        if data is not None:
            robot = lerobot_robot(stated, pipeline.rename, data)
        robot = robot or lerobot_arm(stated, pipeline.rename, cameras)
        config = lerobot_model(stated, _is_pi05(folder, found), chosen.config, robot)
        processing = lerobot_processing(stated, pipeline, robot)
    else:
        assert chosen.config is not None
        config = chosen.config
        if settings.discrete_state_input:
            if not config.pi05:
                raise BadArgument(
                    "--discrete-state-input is for pi0.5; a pi0 policy reads its state as a token of its own."
                )
            config = dataclasses.replace(config, discrete_state_input=True)
        stats = read_norm_stats(folder, settings.norm_stats, settings.asset_id)
        if data is not None:
            robot = openpi_robot(data, stats, RELATIVE_ACTIONS if chosen.name in _OF_RELATIVE_ACTIONS else 0)
        processing = openpi_processing(config, stats, robot or openpi_arm(config, cameras))
    family = "pi05" if config.pi05 else "pi0"
    tokenizer = find_tokenizer(folder, settings.tokenizer)
    source = PolicySource(
        name=stated_name(folder / CONFIG_FILE) or family if found == "openpi_torch" else family,
        # Where the package is installed differs between machines; the name of what it ships does not.
        checkpoint=name if name in SHIPPED else lasting_name(name, folder),
        checkpoint_format=found,
        untrained=False,
        configuration=chosen.source,
        config_name=settings.config_name or "",
        options=settings.stored(),
        downloads=downloads(folder, tokenizer),
    )
    return _Planned(folder, found, config, DTYPES[dtype], PromptTokenizer(tokenizer), processing, source)


def load_pi_policy(settings: PiSettings, device: str | torch.device = "cpu") -> PiPolicy:
    """Load a policy from a checkpoint of any of the three formats."""
    planned = _plan(settings)
    model = load_pi_model(
        planned.folder, planned.config, checkpoint_format=planned.found, dtype=planned.dtype, device=device
    )
    return PiPolicy(model, planned.tokenizer, planned.processing, planned.source)


def check_pi_files(settings: PiSettings) -> None:
    """Raise what `build_pi_policy` would for a checkpoint of this machine that lacks a file; reads no weights."""
    if settings.checkpoint in (*SHIPPED, *_UNTRAINED) or would_be_fetched(settings.checkpoint):
        return
    planned = _plan(settings)
    if planned.found == "openpi_jax":
        params = planned.folder / "params"
        for leaf in list_leaves(params):
            OpenLeaf(params, leaf)
    else:
        with open_tensors(planned.folder):
            pass


def _sizes(config: GemmaConfig) -> str:
    name = next((name for name, variant in GEMMA_VARIANTS.items() if variant == config), "its own sizes")
    return f"width {config.width} and depth {config.depth} ({name})"
