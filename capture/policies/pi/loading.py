"""Load a pi model, or a whole policy, from a checkpoint folder of any format or the options of the command line."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import torch

from vla_attention.capture.policies.checkpoints import UnsupportedCheckpoint
from vla_attention.capture.policies.hub import downloads, hub_version
from vla_attention.capture.policies.identity import PolicySource
from vla_attention.capture.policies.model_arguments import UNTRAINED, UNTRAINED_TINY
from vla_attention.capture.policies.pi.compiled import compile_steps
from vla_attention.capture.policies.pi.config import (
    CAMERA_SLOTS,
    GEMMA_VARIANTS,
    NAMED_CONFIGS,
    GemmaConfig,
    PiConfig,
    find_config,
    find_variant,
)
from vla_attention.capture.policies.pi.data_set_robot import asset_name, lerobot_robot, openpi_robot
from vla_attention.capture.policies.pi.embedded import dummy_policy, embedded_policy
from vla_attention.capture.policies.pi.family import SHIPPED
from vla_attention.capture.policies.pi.formats import CheckpointFormat, detect_format, find_format
from vla_attention.capture.policies.pi.lerobot import load_lerobot, load_lerobot_weights
from vla_attention.capture.policies.pi.lerobot_config import read_lerobot_config
from vla_attention.capture.policies.pi.lerobot_pipeline import read_lerobot_pipeline
from vla_attention.capture.policies.pi.locate import find_checkpoint, find_tokenizer, would_be_fetched
from vla_attention.capture.policies.pi.model import PiModel
from vla_attention.capture.policies.pi.openpi_jax import OpenLeaf, implied_config_name, list_leaves, load_openpi_jax
from vla_attention.capture.policies.pi.openpi_torch import load_openpi_torch, open_tensors
from vla_attention.capture.policies.pi.policy import PiPolicy
from vla_attention.capture.policies.pi.preprocess import RELATIVE_ACTIONS, read_norm_stats
from vla_attention.capture.policies.pi.processing import (
    CAMERA_OF_SLOT,
    OpenpiProcessing,
    Processing,
    simulated_arm,
    simulator_cameras,
)
from vla_attention.capture.policies.pi.sizes import is_pi05
from vla_attention.capture.policies.pi.stated_sizes import (
    CASE_FILE,
    CONFIG_FILE,
    read_config,
    stated_name,
    states_sizes,
)
from vla_attention.capture.policies.pi.tokenizer import PromptTokenizer
from vla_attention.capture.policies.robot import Robot, RobotData
from vla_attention.capture.policies.weights import find_dtype
from vla_attention.schemas.errors import BadArgument, listing


def load_pi_model(
    folder: str | Path,
    *,
    checkpoint_format: CheckpointFormat | None = None,
    config: PiConfig | None = None,
    dtype: torch.dtype = torch.float32,
    device: str | torch.device = "cpu",
) -> tuple[PiModel, CheckpointFormat]:
    """Return the model and the format of the folder; `config` overrides the sizes of the checkpoint."""
    detected = detect_format(folder, checkpoint_format)
    load = {"openpi_torch": load_openpi_torch, "openpi_jax": load_openpi_jax, "lerobot": load_lerobot_weights}[detected]
    return load(folder, config=config, dtype=dtype, device=device), detected


#: The folder of openpi's statistics of DROID, in `assets/`.
DROID_ASSET = "droid"


@dataclasses.dataclass(frozen=True)
class CheckpointOptions:
    """A user's choices for a checkpoint; None takes the checkpoint's own value.

    config_name: one of openpi's names. model_config: a file like case.json. discrete_state_input: openpi's pi0.5 with
    the state in the prompt. norm_stats, asset_id: see `read_norm_stats`. cameras: policy camera -> camera of the
    simulators.
    """

    checkpoint_format: CheckpointFormat | None = None
    config_name: str | None = None
    model_config: Path | None = None
    discrete_state_input: bool = False
    dtype: torch.dtype | None = None
    norm_stats: Path | None = None
    asset_id: str | None = None
    cameras: Mapping[str, str] = dataclasses.field(default_factory=dict)

    def stored(self) -> dict[str, str]:
        """Return the files and names that a rerun needs, for a store's root."""
        given = {"model_config": self.model_config, "norm_stats": self.norm_stats, "asset_id": self.asset_id}
        return {name: str(value) for name, value in given.items() if value is not None}


def load_pi_policy(
    checkpoint: str | Path,
    tokenizer: str | Path,
    *,
    options: CheckpointOptions | None = None,
    config: PiConfig | None = None,
    device: str | torch.device = "cpu",
    data: RobotData | None = None,
    robot: Robot | None = None,
) -> PiPolicy:
    """Load a policy from a checkpoint folder of any of the three formats and a tokenizer file.

    config: the model's configuration, for library callers; the command line names one in `options`. data: the data set
    that the policy is called on, or robot: what was found for it before; with neither it acts in the simulators.
    """
    folder, options = Path(checkpoint), options or CheckpointOptions()
    detected = detect_format(folder, options.checkpoint_format)
    if config is not None:
        chosen = ChosenConfig(config, "given")
    else:
        chosen = choose_config(folder, detected, options, of_data_set=bool(data or robot))
        config = chosen.config
    norm_stats = None if detected == "lerobot" else read_norm_stats(folder, options.norm_stats, options.asset_id)
    if data is not None and norm_stats is None:
        robot = lerobot_robot(folder, data)
    elif data is not None:
        robot = openpi_robot(data, norm_stats, RELATIVE_ACTIONS if chosen.name in _OF_RELATIVE_ACTIONS else 0)
    if options.discrete_state_input and config is not None:
        _check_state_input(config)
    # Small files first: if the tokenizer is missing, the minutes for loading the weights are saved.
    prompt_tokenizer = PromptTokenizer(tokenizer)
    processing: Processing
    if norm_stats is None:
        model, processing = load_lerobot(
            folder,
            sizes=config,
            dtype=options.dtype,
            device=device,
            robot=robot,
            chosen_cameras=options.cameras,
        )
    else:
        cameras = None
        if robot is None:  # before the weights: names may be wrong
            slots = CAMERA_SLOTS if config is None else config.cameras
            cameras = simulator_cameras(slots, CAMERA_OF_SLOT, options.cameras)
        dtype = options.dtype or torch.float32
        model, _ = load_pi_model(folder, checkpoint_format=detected, config=config, dtype=dtype, device=device)
        if options.discrete_state_input:
            _check_state_input(model.config)
            model.config = dataclasses.replace(model.config, discrete_state_input=True)
        pi05 = model.config.pi05
        # openpi's LIBERO configurations: pi0.5 quantiles and plain actions, pi0 z-scores and actions relative to the
        # state.
        processing = OpenpiProcessing(
            model.config,
            norm_stats,
            normalisation="quantile" if pi05 else "z-score",
            relative_actions=not pi05,
            robot=robot,
            cameras=cameras,
        )
    family = "pi05" if model.config.pi05 else "pi0"
    source = PolicySource(
        name=stated_name(folder / CONFIG_FILE) or family if detected == "openpi_torch" else family,
        checkpoint=str(checkpoint),
        checkpoint_format=detected,
        untrained=False,
        configuration=chosen.source,
        config_name=chosen.name if chosen.stated else "",
        options=options.stored(),
    )
    return PiPolicy(model, prompt_tokenizer, processing, source)


#: openpi's configurations of pi0 in LIBERO, whose data have actions relative to the state.
_OF_RELATIVE_ACTIONS = ("pi0_libero", "pi0_libero_low_mem_finetune")


@dataclass(frozen=True)
class ChosenConfig:
    """The configuration that a checkpoint is loaded with.

    config: None if the checkpoint's own files determine it. source: where it is from, in words. name: openpi's for it,
    empty without one. stated: the user named it; otherwise the checkpoint's files imply the name.
    """

    config: PiConfig | None
    source: str
    name: str = ""
    stated: bool = False

    @classmethod
    def named(cls, name: str, why: str = "", *, stated: bool = False) -> ChosenConfig:
        """Openpi's configuration of that name."""
        return cls(find_config(name), f"openpi's {name}{why}", name, stated)


def choose_config(
    folder: Path, found: CheckpointFormat, options: CheckpointOptions, *, of_data_set: bool = False
) -> ChosenConfig:
    """Return the configuration of the options, of a case.json beside the checkpoint, or that the checkpoint implies.

    of_data_set: the policy is for the robot of a data set, which the name of the checkpoint's statistics may tell.

    Raises:
        BadArgument: options contradict each other or the format.
        UnsupportedCheckpoint: nothing states the configuration.
    """
    if options.config_name is not None and options.model_config is not None:
        raise BadArgument("Give --config-name or --model-config, not both.")
    if found == "lerobot" and (options.config_name is not None or options.discrete_state_input):
        raise BadArgument(
            "A LeRobot checkpoint states its configuration in config.json; leave --config-name and "
            "--discrete-state-input out."
        )
    if options.norm_stats is not None and options.asset_id is not None:
        raise BadArgument("Give --norm-stats or --asset-id, not both.")
    if found == "lerobot" and (options.norm_stats is not None or options.asset_id is not None):
        raise BadArgument(
            "A LeRobot checkpoint has its statistics in its saved pipelines (policy_preprocessor.json); leave "
            "--norm-stats and --asset-id out."
        )
    if options.config_name is not None:
        return ChosenConfig.named(options.config_name, stated=True)
    if options.model_config is not None:
        path = options.model_config.expanduser()
        return ChosenConfig(read_config(path), str(path))
    beside = folder.absolute().parent / CASE_FILE
    if beside.is_file():
        return ChosenConfig(read_config(beside), f"{CASE_FILE} beside the checkpoint")
    if found == "openpi_torch" and states_sizes(folder / CONFIG_FILE):
        return ChosenConfig(read_config(folder / CONFIG_FILE), CONFIG_FILE)
    if of_data_set and found != "lerobot" and (options.asset_id or asset_name(folder)) == DROID_ASSET:
        name = _droid_config_name(folder, found)
        return ChosenConfig.named(name, f" (its statistics are those of '{DROID_ASSET}')")
    if found == "openpi_jax":
        name = implied_config_name(leaf.path for leaf in list_leaves(folder / "params"))
        return ChosenConfig.named(name, " (not stated by the checkpoint)")
    if not (folder / CONFIG_FILE).is_file():
        with open_tensors(folder) as tensors:
            is_pi05(tensors.shapes)  # whatever else it may be comes first
        raise UnsupportedCheckpoint(
            f"'{folder}' has no {CONFIG_FILE}, as openpi's train_pytorch.py leaves it, so that nothing states its "
            f"heads and the actions of a call. Give --config-name NAME (openpi's {listing(NAMED_CONFIGS)}), or "
            f"--model-config FILE, a file like {CASE_FILE} (docs/checkpoints.md)."
        )
    return ChosenConfig(None, "config.json and the tensors")


def _droid_config_name(folder: Path, found: CheckpointFormat) -> str:
    if found == "openpi_jax":
        pi05 = implied_config_name(leaf.path for leaf in list_leaves(folder / "params")) == "pi05_libero"
    else:
        with open_tensors(folder) as tensors:
            pi05 = is_pi05(tensors.shapes)
    return "pi05_droid" if pi05 else "pi0_droid"


def _check_state_input(config: PiConfig) -> None:
    if not config.pi05:
        raise BadArgument("--discrete-state-input is for pi0.5; a pi0 policy reads its state as a token of its own.")


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
    norm_stats: Path | None = None,
    asset_id: str | None = None,
    cameras: Mapping[str, str] | None = None,
    data: RobotData | None = None,
    robot: Robot | None = None,
    compiled: bool = False,
) -> PiPolicy:
    """Build the policy and check the options against it.

    `checkpoint` is a folder, a name on a hub, or one of the two untrained policies that come with the package:
    `untrained`, `untrained-tiny`. `compiled`: denoise steps through torch.compile. `data` and `robot`: see
    `load_pi_policy`; with either, there are no `cameras` of simulators to choose. Raises `BadArgument` if a variant or
    the number of image tokens contradicts the policy, or if nothing can be compiled here.
    """
    wanted = {
        "--paligemma-variant": find_variant(paligemma_variant) if paligemma_variant else None,
        "--action-expert-variant": find_variant(action_expert_variant) if action_expert_variant else None,
    }
    if cameras and data is None and robot is not None:
        raise BadArgument("Cannot use --camera: the pictures of a data set's store are chosen already; leave it out.")
    options = CheckpointOptions(
        checkpoint_format=find_format(checkpoint_format) if checkpoint_format else None,
        config_name=config_name,
        model_config=model_config,
        discrete_state_input=discrete_state_input,
        dtype=find_dtype(dtype) if dtype else None,
        norm_stats=norm_stats,
        asset_id=asset_id,
        cameras={} if data is not None or cameras is None else cameras,
    )
    if config_name is not None:
        find_config(config_name)  # an unknown name is reported before any download
    if checkpoint in _UNTRAINED:
        of_checkpoints = dataclasses.replace(options, dtype=None, cameras={}) != CheckpointOptions()
        if of_checkpoints or options.dtype == torch.bfloat16:
            raise BadArgument(
                f"The policy '{checkpoint}' comes with the program, in float32; --checkpoint-format, --config-name, "
                "--model-config, --discrete-state-input, --norm-stats, --asset-id and --dtype bfloat16 are for "
                "checkpoints."
            )
        if data is not None:
            robot = openpi_robot(data, None)
        elif options.cameras:
            robot = simulated_arm(simulator_cameras(CAMERA_SLOTS, CAMERA_OF_SLOT, options.cameras))
        policy = _UNTRAINED[checkpoint](device=device, robot=robot)
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


def check_pi_files(
    checkpoint: str,
    *,
    tokenizer: str | None,
    checkpoint_format: str | None,
    config_name: str | None,
    model_config: Path | None,
    norm_stats: Path | None,
    asset_id: str | None,
) -> None:
    """Raise what `build_pi_policy` would for a checkpoint of this machine that lacks a file; reads no weights."""
    if checkpoint in (*SHIPPED, *_UNTRAINED) or would_be_fetched(checkpoint):
        return
    folder = find_checkpoint(checkpoint)
    options = CheckpointOptions(
        checkpoint_format=find_format(checkpoint_format) if checkpoint_format else None,
        config_name=config_name,
        model_config=model_config,
        norm_stats=norm_stats,
        asset_id=asset_id,
    )
    found = detect_format(folder, options.checkpoint_format)
    choose_config(folder, found, options)
    if found == "openpi_jax":
        for leaf in list_leaves(folder / "params"):
            OpenLeaf(folder / "params", leaf)
    else:
        with open_tensors(folder):
            pass
    if found == "lerobot":
        read_lerobot_pipeline(folder, read_lerobot_config(folder))
    else:
        read_norm_stats(folder, norm_stats, asset_id)
    find_tokenizer(folder, tokenizer)


def _sizes(config: GemmaConfig) -> str:
    name = next((name for name, variant in GEMMA_VARIANTS.items() if variant == config), "its own sizes")
    return f"width {config.width} and depth {config.depth} ({name})"
