"""Multi-Task DiT of LeRobot: noisy actions that read each other (`self`), and nothing else.

Pictures, words and state come in as one vector, which scales and shifts every token (adaLN): no key holds them. Only
the actions from the present on are returned; those before and after them are keys, but no action queries.
"""

from __future__ import annotations

from vla_attention.capture.torch_policies.layouts.layout_building import FoundModule, KeyOrder
from vla_attention.capture.torch_policies.policy_layout import PolicyLayout

_NAME = "multi_task_dit"
#: Places inside an integration step where the network is evaluated.
_PLACES = {"euler": (0.0,), "rk4": (0.0, 0.5, 0.5, 1.0)}


def multi_task_dit(policy: object) -> PolicyLayout:
    """Return the layout of a `MultiTaskDiTPolicy`, or of an object that holds one.

    Site `self` (keys: actions of past steps, the returned chunk, later actions). There is no key of a picture or word.

    Raises:
        NotThisPolicy: no MultiTaskDiTPolicy.
    """
    found = FoundModule(policy, ("MultiTaskDiTPolicy",), _NAME)
    config = found.module.config
    start, stop = config.n_obs_steps - 1, min(config.n_obs_steps - 1 + config.n_action_steps, config.horizon)
    keys = KeyOrder()
    keys.add("past_actions", "action", start, "action")
    keys.add("actions", "action", stop - start, "action")
    keys.add("later_actions", "action", config.horizon - stop, "action")
    times: tuple[float, ...] = ()
    if config.is_flow_matching:
        steps, places = config.num_integration_steps, _PLACES[config.integration_method]
        times = tuple((step + place) / steps for step in range(steps) for place in places)
    return PolicyLayout(
        name=_NAME,
        family=_NAME,
        sites=(keys.site("self", (start, stop)),),
        rules=(
            found.rule(r"noise_predictor\.transformer_blocks\.(?P<block>\d+)\.(attn|multihead_attn)", "self"),
            found.rule(r"observation_encoder\..*"),
        ),
        num_layers=config.num_layers,
        num_heads=config.num_heads,
        num_denoise_steps=len(times) or found.module.objective.num_inference_steps,
        denoise_times=times,
        action_horizon=stop - start,
        action_dim=config.action_feature.shape[0],
        versions={"lerobot": ("0.5.", "0.6.")},
    )
