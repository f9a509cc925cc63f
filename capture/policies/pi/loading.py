"""Load a pi model, or a whole policy, from a checkpoint folder of any format."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path

import torch

from vla_attention.capture.policies.identity import PolicySource
from vla_attention.capture.policies.parity_case import CASE_FILE
from vla_attention.capture.policies.pi.case import CONFIG_FILE, read_config, stated_name, states_sizes
from vla_attention.capture.policies.pi.config import PiConfig, find_config
from vla_attention.capture.policies.pi.data_set_robot import asset_name, robot_for
from vla_attention.capture.policies.pi.formats import CheckpointFormat, detect_format
from vla_attention.capture.policies.pi.lerobot import load_lerobot, load_lerobot_weights
from vla_attention.capture.policies.pi.model import PiModel
from vla_attention.capture.policies.pi.openpi_jax import implied_config_name, list_leaves, load_openpi_jax
from vla_attention.capture.policies.pi.openpi_torch import load_openpi_torch, open_tensors
from vla_attention.capture.policies.pi.policy import PiPolicy
from vla_attention.capture.policies.pi.preprocess import RELATIVE_ACTIONS, read_norm_stats
from vla_attention.capture.policies.pi.processing import OpenpiProcessing, Processing
from vla_attention.capture.policies.pi.sizes import is_pi05
from vla_attention.capture.policies.pi.tokenizer import PromptTokenizer
from vla_attention.capture.policies.robot import Robot, RobotData
from vla_attention.schemas.errors import BadArgument


def load_pi_model(
    folder: str | Path,
    *,
    checkpoint_format: CheckpointFormat | None = None,
    config: PiConfig | None = None,
    dtype: torch.dtype = torch.float32,
    device: str | torch.device = "cpu",
) -> tuple[PiModel, CheckpointFormat]:
    """Return the model and the format of the folder; `config` overrides the sizes of the checkpoint."""
    found = detect_format(folder, checkpoint_format)
    load = {"openpi_torch": load_openpi_torch, "openpi_jax": load_openpi_jax, "lerobot": load_lerobot_weights}[found]
    return load(folder, config=config, dtype=dtype, device=device), found


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
    found = detect_format(folder, options.checkpoint_format)
    if config is not None:
        chosen = ChosenConfig(config, "given")
    else:
        chosen = choose_config(folder, found, options, of_data_set=bool(data or robot))
        config = chosen.config
    if data is not None:
        relative = RELATIVE_ACTIONS if chosen.name in _OF_RELATIVE_ACTIONS else 0
        robot = robot_for(folder, found, data, relative_actions=relative)
    if options.discrete_state_input and config is not None:
        _check_state_input(config)
    # Small files first: if the tokenizer is missing, the minutes for loading the weights are saved.
    prompt_tokenizer = PromptTokenizer(tokenizer)
    processing: Processing
    if found == "lerobot":
        model, processing = load_lerobot(folder, sizes=config, dtype=options.dtype, device=device, robot=robot)
    else:
        norm_stats = read_norm_stats(folder)
        dtype = options.dtype or torch.float32
        model, _ = load_pi_model(folder, checkpoint_format=found, config=config, dtype=dtype, device=device)
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
        name=stated_name(folder / CONFIG_FILE) or family if found == "openpi_torch" else family,
        checkpoint=str(checkpoint),
        checkpoint_format=found,
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
