"""The batch scripts' environment variables as arguments: `evaluate-attention-ratio --from-environment`.

The heads of the batch scripts, `scripts/run_attention_ratio*.sh`, document the variables. Variables of a
single policy family are in its `PublishedScript`.
"""

from __future__ import annotations

import shlex
from collections.abc import Mapping

from vla_attention.capture.policies.families import policy_families
from vla_attention.capture.policies.family import PolicyFamily
from vla_attention.schemas.errors import BadArgument

#: Variable -> option, for variables that are passed on unchanged.
_OPTIONS = {
    "CONFIG_NAME": "--config-name",
    "TASK_SUITE": "--task-suite",
    "OUTPUT_DIR": "--output-dir",
    "STORE": "--store",
    "STAGE": "--stage",
}
_WHOLE_NUMBERS = {
    "NUM_EPISODES": "--num-episodes",
    "SEED": "--seed",
    "REPLAN_STEPS": "--replan-steps",
    "MAX_REQUEUES": "--max-requeues",
}
#: Variable, option, and what is expected.
_SEVERAL_NUMBERS = (
    ("TASK_ID", "--task-id", "a whole number, or several separated by spaces"),
    ("LAYERS", "--layers", 'layer numbers separated by spaces, as in LAYERS="25 26 27"'),
)
_SWITCH = {"1": True, "true": True, "yes": True, "": False, "0": False, "false": False, "no": False}


def arguments_from_environment(environment: Mapping[str, str], family: PolicyFamily) -> list[str]:
    """Return the arguments for the variables. An empty variable counts as not set.

    Raises:
        BadArgument: a variable has a value that it cannot have, or belongs to another family's script.
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
    for name, option, described in _SEVERAL_NUMBERS:
        numbers = given.get(name, "").split()
        if not all(number.isdecimal() for number in numbers):
            raise BadArgument(f"{name} is '{given[name]}'; expected {described}.")
        if numbers:
            arguments += [option, *numbers]
    arguments += _family_arguments(given, family)
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
    elif in_slurm and stage != "analyze" and (not checkpoint or checkpoint not in family.built_in):
        # A job without a GPU fails at once, instead of running on the CPU until its time is over.
        arguments += ["--device", "cuda"]
    try:
        return [*arguments, *shlex.split(get("ARGS", ""))]
    except ValueError as error:
        raise BadArgument(f"ARGS is '{given['ARGS']}', which cannot be read as arguments: {error}.") from None


def describe_job(environment: Mapping[str, str], host: str) -> str:
    """Return the first line of a SLURM job's log; empty without SLURM."""
    job = environment.get("SLURM_JOB_ID")
    if not job:
        return ""
    array, index = environment.get("SLURM_ARRAY_JOB_ID"), environment.get("SLURM_ARRAY_TASK_ID")
    name = f"{array}_{index}" if array and index else job
    restarts = environment.get("SLURM_RESTART_COUNT", "0")
    return f"Job {name} on {host}" + (f", requeued {restarts} times." if restarts != "0" else ".")


def _family_arguments(given: Mapping[str, str], family: PolicyFamily) -> list[str]:
    """Return the options of the family's own variables; `BadArgument` for a variable of another family."""
    own = family.published.variables if family.published else {}
    for other in policy_families():
        for name in other.published.variables if other.published else {}:
            if given.get(name) and name not in own:
                raise BadArgument(f"{name} is for {other.title}, and means nothing to {family.title}; unset it.")
    return [word for name, option in own.items() if given.get(name) for word in (option, given[name])]


def _checkpoint(given: Mapping[str, str]) -> str:
    one, other = given.get("CHECKPOINT", ""), given.get("CKPT_PATH", "")
    if one and other and one != other:
        raise BadArgument(f"CHECKPOINT is '{one}' and CKPT_PATH is '{other}'; give one of them.")
    return one or other
