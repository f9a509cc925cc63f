"""The batch scripts' environment variables as arguments: `evaluate-attention-ratio --from-environment`.

The heads of `scripts/run_attention_ratio.sh` and `scripts/run_attention_ratio_cosmos.sh` document them; here is what they mean.
"""

from __future__ import annotations

import shlex
from collections.abc import Mapping

from vla_attention.schemas.errors import BadArgument

#: Variable -> option, for those that are passed on as they are.
_OPTIONS = {
    "CONFIG_NAME": "--config-name",
    "TASK_SUITE": "--task-suite",
    "OUTPUT_DIR": "--output-dir",
    "STORE": "--store",
    "STAGE": "--stage",
}
_WHOLE_NUMBERS = {
    "TASK_ID": "--task-id",
    "NUM_EPISODES": "--num-episodes",
    "SEED": "--seed",
    "REPLAN_STEPS": "--replan-steps",
    "MAX_REQUEUES": "--max-requeues",
}
_FRAMES = {"QUERY_FRAME": "--query-frame", "VISUAL_FRAME": "--visual-frame", "TEXT_FRAME": "--text-frame"}
_SWITCH = {"1": True, "true": True, "yes": True, "": False, "0": False, "false": False, "no": False}
#: Policies that come with the tool and run anywhere.
_SMALL = ("embedded", "dummy")


def arguments_from_environment(environment: Mapping[str, str], family: str, default_checkpoint: str) -> list[str]:
    """Arguments that say what the variables say; an empty variable is one that is not set.

    Raises:
        BadArgument: a variable has a value that it cannot have. The sentence names it.
    """
    given = {name: value.strip() for name, value in environment.items()}
    get = given.get
    arguments: list[str] = []
    for name, option in _OPTIONS.items():
        if get(name):
            arguments += [option, given[name]]
    for name, option in _WHOLE_NUMBERS.items():
        if get(name):
            if not given[name].isdecimal():
                raise BadArgument(f"{name} is '{given[name]}'; expected a whole number.")
            arguments += [option, given[name]]
    if get("LAYERS"):
        layers = given["LAYERS"].split()
        if not all(layer.isdecimal() for layer in layers):
            raise BadArgument(
                f"LAYERS is '{given['LAYERS']}'; expected layer numbers separated by spaces, as in LAYERS=\"25 26 27\"."
            )
        arguments += ["--layers", *layers]
    for name, option in _FRAMES.items():
        if get(name):
            if family == "pi":
                raise BadArgument(
                    f"{name} is for Cosmos policies (scripts/run_attention_ratio_cosmos.sh); a pi policy has no frames."
                )
            arguments += [option, given[name]]
    save_viz = _SWITCH.get(get("SAVE_VIZ", "").lower())
    if save_viz is None:
        raise BadArgument(f"SAVE_VIZ is '{given['SAVE_VIZ']}'; expected 1 or 0.")
    if save_viz:
        arguments += ["--save-viz"]
    checkpoint = _checkpoint(given)
    if checkpoint:
        arguments += ["--checkpoint", checkpoint]
    in_slurm, stage = bool(get("SLURM_JOB_ID")), get("STAGE")
    if get("SLURM_ARRAY_TASK_ID") and stage != "analyze":
        arguments += ["--array-index", given["SLURM_ARRAY_TASK_ID"]]
    if get("DEVICE"):
        arguments += ["--device", given["DEVICE"]]
    elif in_slurm and stage != "analyze" and (checkpoint or default_checkpoint) not in _SMALL:
        # A job that got no GPU shall say so at once, instead of crawling on the CPU until its time is over.
        arguments += ["--device", "cuda"]
    try:
        return [*arguments, *shlex.split(get("ARGS", ""))]
    except ValueError as error:
        raise BadArgument(f"ARGS is '{given['ARGS']}', which cannot be read as arguments: {error}.") from None


def describe_job(environment: Mapping[str, str], host: str) -> str:
    """The line that begins a SLURM job's log; empty without SLURM."""
    job = environment.get("SLURM_JOB_ID")
    if not job:
        return ""
    array, index = environment.get("SLURM_ARRAY_JOB_ID"), environment.get("SLURM_ARRAY_TASK_ID")
    name = f"{array}_{index}" if array and index else job
    restarts = environment.get("SLURM_RESTART_COUNT", "0")
    return f"Job {name} on {host}" + (f", requeued {restarts} times." if restarts != "0" else ".")


def _checkpoint(given: Mapping[str, str]) -> str:
    one, other = given.get("CHECKPOINT", ""), given.get("CKPT_PATH", "")
    if one and other and one != other:
        raise BadArgument(f"CHECKPOINT is '{one}' and CKPT_PATH is '{other}'; give one of them.")
    return one or other
