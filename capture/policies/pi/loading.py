"""Load a pi model, or a whole policy, from a checkpoint folder of any format or the options of the command line."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path

import torch

from vla_attention.capture.environments.episode_protocol import CAMERAS
from vla_attention.capture.policies.checkpoints import UnsupportedCheckpoint
from vla_attention.capture.policies.family import UNTRAINED, UNTRAINED_TINY
from vla_attention.capture.policies.hub import downloads, lasting_name
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
from vla_attention.capture.policies.pi.data_set_robot import asset_name, lerobot_robot, openpi_robot
from vla_attention.capture.policies.pi.embedded import dummy_policy, embedded_policy
from vla_attention.capture.policies.pi.family import SHIPPED, PiSettings
from vla_attention.capture.policies.pi.formats import CheckpointFormat, detect_format
from vla_attention.capture.policies.pi.lerobot import load_lerobot
from vla_attention.capture.policies.pi.lerobot_config import read_lerobot_config
from vla_attention.capture.policies.pi.lerobot_pipeline import read_lerobot_pipeline
from vla_attention.capture.policies.pi.locate import find_checkpoint, find_tokenizer, would_be_fetched
from vla_attention.capture.policies.pi.model import PiModel
from vla_attention.capture.policies.pi.openpi_jax import OpenLeaf, list_leaves, load_openpi_jax
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
from vla_attention.capture.policies.robot import read_camera_choices
from vla_attention.capture.policies.weights import DTYPES
from vla_attention.schemas.errors import BadArgument, listing


def load_pi_model(
    folder: str | Path,
    *,
    checkpoint_format: CheckpointFormat | None = None,
    config: PiConfig | None = None,
    dtype: torch.dtype = torch.float32,
    device: str | torch.device = "cpu",
) -> tuple[PiModel, CheckpointFormat]:
    """Return the model and the format of the folder; `config` overrides the sizes of the checkpoint.

    Of a LeRobot checkpoint only the tensors are read, so that it needs a `config`; see `load_lerobot`.
    """
    detected = detect_format(folder, checkpoint_format)
    if detected != "openpi_jax":
        return load_openpi_torch(folder, config=config, dtype=dtype, device=device), detected
    config = config or find_config("pi05_libero" if _is_pi05(Path(folder), detected) else "pi0_libero")
    return load_openpi_jax(folder, config=config, dtype=dtype, device=device), detected


#: The folder of openpi's statistics of DROID, in `assets/`.
DROID_ASSET = "droid"


def load_pi_policy(
    checkpoint: str | Path,
    tokenizer: str | Path,
    settings: PiSettings | None = None,
    *,
    config: PiConfig | None = None,
    device: str | torch.device = "cpu",
) -> PiPolicy:
    """Load a policy from a checkpoint folder of any of the three formats and a tokenizer file.

    settings: of which `checkpoint` and `device` are not used. config: the model's configuration, for library callers;
    the command line names one in `settings`.
    """
    folder, settings = Path(checkpoint), settings or PiSettings()
    data, robot = settings.robot_data, settings.robot
    chosen_cameras = {} if data is not None else read_camera_choices(settings.camera, CAMERAS)
    given_dtype = None if settings.dtype is None else DTYPES[settings.dtype]
    detected = detect_format(folder, settings.checkpoint_format)
    if config is not None:
        chosen = ChosenConfig(config, "given")
    else:
        chosen = choose_config(folder, detected, settings, of_data_set=bool(data or robot))
        config = chosen.config
    norm_stats = None if detected == "lerobot" else read_norm_stats(folder, settings.norm_stats, settings.asset_id)
    if data is not None and norm_stats is None:
        robot = lerobot_robot(folder, data)
    elif data is not None:
        robot = openpi_robot(data, norm_stats, RELATIVE_ACTIONS if chosen.name in _OF_RELATIVE_ACTIONS else 0)
    if settings.discrete_state_input and config is not None:
        _check_state_input(config)
    # Small files first: if the tokenizer is missing, the minutes for loading the weights are saved.
    prompt_tokenizer = PromptTokenizer(tokenizer)
    processing: Processing
    if norm_stats is None:
        model, processing = load_lerobot(
            folder,
            sizes=config,
            dtype=given_dtype,
            device=device,
            robot=robot,
            chosen_cameras=chosen_cameras,
        )
    else:
        cameras = None
        if robot is None:  # before the weights: names may be wrong
            slots = CAMERA_SLOTS if config is None else config.cameras
            cameras = simulator_cameras(slots, CAMERA_OF_SLOT, chosen_cameras)
        dtype = given_dtype or torch.float32
        model, _ = load_pi_model(folder, checkpoint_format=detected, config=config, dtype=dtype, device=device)
        if settings.discrete_state_input:
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
        options=settings.stored(),
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
    folder: Path, found: CheckpointFormat, settings: PiSettings, *, of_data_set: bool = False
) -> ChosenConfig:
    """Return the configuration of the settings, of a case.json beside the checkpoint, or that the checkpoint implies.

    of_data_set: the policy is for the robot of a data set, which the name of the checkpoint's statistics may tell.

    Raises:
        BadArgument: settings contradict each other or the format.
        UnsupportedCheckpoint: nothing states the configuration.
    """
    of_config = settings.config_name is not None or settings.discrete_state_input
    of_statistics = settings.norm_stats is not None or settings.asset_id is not None
    for is_wrong, said in (
        (settings.config_name and settings.model_config, "Give --config-name or --model-config, not both."),
        (settings.norm_stats and settings.asset_id, "Give --norm-stats or --asset-id, not both."),
        (
            found == "lerobot" and of_config,
            "A LeRobot checkpoint states its configuration in config.json; leave --config-name and "
            "--discrete-state-input out.",
        ),
        (
            found == "lerobot" and of_statistics,
            "A LeRobot checkpoint has its statistics in its saved pipelines (policy_preprocessor.json); leave "
            "--norm-stats and --asset-id out.",
        ),
    ):
        if is_wrong:
            raise BadArgument(said)
    if settings.config_name is not None:
        return ChosenConfig.named(settings.config_name, stated=True)
    if settings.model_config is not None:
        path = settings.model_config.expanduser()
        return ChosenConfig(read_config(path), str(path))
    beside = folder.absolute().parent / CASE_FILE
    if beside.is_file():
        return ChosenConfig(read_config(beside), f"{CASE_FILE} beside the checkpoint")
    if found == "openpi_torch" and states_sizes(folder / CONFIG_FILE):
        return ChosenConfig(read_config(folder / CONFIG_FILE), CONFIG_FILE)
    if of_data_set and found != "lerobot" and (settings.asset_id or asset_name(folder)) == DROID_ASSET:
        name = "pi05_droid" if _is_pi05(folder, found) else "pi0_droid"
        return ChosenConfig.named(name, f" (its statistics are those of '{DROID_ASSET}')")
    if found == "openpi_jax":
        name = "pi05_libero" if _is_pi05(folder, found) else "pi0_libero"
        return ChosenConfig.named(name, " (not stated by the checkpoint)")
    if not (folder / CONFIG_FILE).is_file():
        _is_pi05(folder, found)  # whatever else it may be comes first
        raise UnsupportedCheckpoint(
            f"'{folder}' has no {CONFIG_FILE}, as openpi's train_pytorch.py leaves it, so that nothing states its "
            f"heads and the actions of a call. Give --config-name NAME (openpi's {listing(NAMED_CONFIGS)}), or "
            f"--model-config FILE, a file like {CASE_FILE} (docs/checkpoints.md)."
        )
    return ChosenConfig(None, "config.json")


def _is_pi05(folder: Path, found: CheckpointFormat) -> bool:
    """Whether a checkpoint is pi0.5's; of openpi's JAX format, one without a projection of the state."""
    if found == "openpi_jax":
        return not any(leaf.path.startswith("state_proj/") for leaf in list_leaves(folder / "params"))
    with open_tensors(folder) as tensors:
        return is_pi05(tensors.shapes)


def _check_state_input(config: PiConfig) -> None:
    if not config.pi05:
        raise BadArgument("--discrete-state-input is for pi0.5; a pi0 policy reads its state as a token of its own.")


_UNTRAINED = {UNTRAINED: embedded_policy, UNTRAINED_TINY: dummy_policy}


def build_pi_policy(settings: PiSettings, device: str) -> PiPolicy:
    """Build the policy and check the settings against it.

    Raises `BadArgument` if a variant or the number of image tokens contradicts the policy.
    """
    checkpoint, robot, data = settings.checkpoint, settings.robot, settings.robot_data
    named = (settings.paligemma_variant, settings.action_expert_variant)
    variants = [find_variant(name) if name else None for name in named]
    cameras = {} if data is not None else read_camera_choices(settings.camera, CAMERAS)
    if cameras and robot is not None:
        raise BadArgument("Cannot use --camera: the pictures of a data set's store are chosen already; leave it out.")
    if settings.config_name is not None:
        find_config(settings.config_name)  # an unknown name is reported before any download
    if checkpoint in _UNTRAINED:
        sizes = (settings.checkpoint_format, settings.config_name, settings.model_config, *settings.stored())
        if any(sizes) or settings.discrete_state_input or settings.dtype == "bfloat16":
            raise BadArgument(
                f"The policy '{checkpoint}' comes with the program, in float32; --checkpoint-format, --config-name, "
                "--model-config, --discrete-state-input, --norm-stats, --asset-id and --dtype bfloat16 are for "
                "checkpoints."
            )
        if data is not None:
            robot = openpi_robot(data, None)
        elif cameras:
            robot = simulated_arm(simulator_cameras(CAMERA_SLOTS, CAMERA_OF_SLOT, cameras))
        policy = _UNTRAINED[checkpoint](device=device, robot=robot)
    else:
        path = SHIPPED[checkpoint] if checkpoint in SHIPPED else find_checkpoint(checkpoint)
        detect_format(path, settings.checkpoint_format)  # a folder without a checkpoint is reported first
        tokenizer_path = find_tokenizer(path, settings.tokenizer)
        policy = load_pi_policy(path, tokenizer_path, settings, device=device)
        # Where the package is installed differs between machines; the name of what it ships does not.
        lasting = checkpoint if checkpoint in SHIPPED else lasting_name(checkpoint, path)
        policy.source = dataclasses.replace(
            policy.source, downloads=downloads(path, tokenizer_path), checkpoint=lasting
        )
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


def check_pi_files(settings: PiSettings) -> None:
    """Raise what `build_pi_policy` would for a checkpoint of this machine that lacks a file; reads no weights."""
    checkpoint = settings.checkpoint
    if checkpoint in (*SHIPPED, *_UNTRAINED) or would_be_fetched(checkpoint):
        return
    folder = find_checkpoint(checkpoint)
    found = detect_format(folder, settings.checkpoint_format)
    choose_config(folder, found, settings)
    if found == "openpi_jax":
        for leaf in list_leaves(folder / "params"):
            OpenLeaf(folder / "params", leaf)
    else:
        with open_tensors(folder):
            pass
    if found == "lerobot":
        read_lerobot_pipeline(folder, read_lerobot_config(folder))
    else:
        read_norm_stats(folder, settings.norm_stats, settings.asset_id)
    find_tokenizer(folder, settings.tokenizer)


def _sizes(config: GemmaConfig) -> str:
    name = next((name for name, variant in GEMMA_VARIANTS.items() if variant == config), "its own sizes")
    return f"width {config.width} and depth {config.depth} ({name})"
