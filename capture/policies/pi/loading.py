"""Load a pi model, or a whole policy, from a checkpoint folder of any format or the options of the command line."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path

import torch

from vla_attention.capture.policies.hub import downloads, hub_version
from vla_attention.capture.policies.identity import PolicySource
from vla_attention.capture.policies.model_arguments import UNTRAINED, UNTRAINED_TINY, check_not_renamed
from vla_attention.capture.policies.parity_case import CASE_FILE
from vla_attention.capture.policies.pi.case import CONFIG_FILE, read_config, stated_name, states_sizes
from vla_attention.capture.policies.pi.compiled import compile_steps
from vla_attention.capture.policies.pi.config import GEMMA_VARIANTS, GemmaConfig, PiConfig, find_config, find_variant
from vla_attention.capture.policies.pi.data_set_robot import asset_name, robot_for, untrained_robot
from vla_attention.capture.policies.pi.embedded import dummy_policy, embedded_policy
from vla_attention.capture.policies.pi.family import SHIPPED
from vla_attention.capture.policies.pi.formats import CheckpointFormat, detect_format, find_format
from vla_attention.capture.policies.pi.lerobot import load_lerobot, load_lerobot_weights
from vla_attention.capture.policies.pi.locate import find_checkpoint, find_tokenizer
from vla_attention.capture.policies.pi.model import PiModel
from vla_attention.capture.policies.pi.openpi_jax import implied_config_name, list_leaves, load_openpi_jax
from vla_attention.capture.policies.pi.openpi_torch import load_openpi_torch, open_tensors
from vla_attention.capture.policies.pi.policy import PiPolicy
from vla_attention.capture.policies.pi.preprocess import RELATIVE_ACTIONS, read_norm_stats
from vla_attention.capture.policies.pi.processing import OpenpiProcessing, Processing
from vla_attention.capture.policies.pi.sizes import is_pi05
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
    the state in the prompt.
    """

    checkpoint_format: CheckpointFormat | None = None
    config_name: str | None = None
    model_config: Path | None = None
    discrete_state_input: bool = False
    dtype: torch.dtype | None = None


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
    if data is not None:
        relative = RELATIVE_ACTIONS if chosen.name in _OF_RELATIVE_ACTIONS else 0
        robot = robot_for(folder, detected, data, relative_actions=relative)
    if options.discrete_state_input and config is not None:
        _check_state_input(config)
    # Small files first: if the tokenizer is missing, the minutes for loading the weights are saved.
    prompt_tokenizer = PromptTokenizer(tokenizer)
    processing: Processing
    if detected == "lerobot":
        model, processing = load_lerobot(folder, sizes=config, dtype=options.dtype, device=device, robot=robot)
    else:
        norm_stats = read_norm_stats(folder)
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
        )
    family = "pi05" if model.config.pi05 else "pi0"
    source = PolicySource(
        name=stated_name(folder / CONFIG_FILE) or family if detected == "openpi_torch" else family,
        checkpoint=str(checkpoint),
        checkpoint_format=detected,
        untrained=False,
        configuration=chosen.source,
        config_name=chosen.name if chosen.stated else "",
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

    of_data_set: the policy is for the robot of a
    data set, which the name of the checkpoint's statistics may tell.
    """
    if options.config_name is not None and options.model_config is not None:
        raise BadArgument("Give --config-name or --model-config, not both.")
    if found == "lerobot" and (options.config_name is not None or options.discrete_state_input):
        raise BadArgument(
            "A LeRobot checkpoint states its configuration in config.json; leave --config-name and "
            "--discrete-state-input out."
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
    if of_data_set and found != "lerobot" and asset_name(folder) == DROID_ASSET:
        name = _droid_config_name(folder, found)
        return ChosenConfig.named(name, f" (its statistics are those of '{DROID_ASSET}')")
    if found == "openpi_jax":
        name = implied_config_name(leaf.path for leaf in list_leaves(folder / "params"))
        return ChosenConfig.named(name, " (not stated by the checkpoint)")
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
