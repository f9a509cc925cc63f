"""Published success rates of checkpoints of this family, for `vla-capture doctor --accept`."""

from __future__ import annotations

from vla_attention.capture.policies.family import PublishedRate
from vla_attention.capture.policies.pi.shipped import CUBES_POLICY

_OPENPI = "examples/libero/README.md of openpi"
_LEROBOT = "docs/source/libero.mdx of LeRobot"
#: Per cent by suite. openpi's client runs 50 episodes of each of the ten tasks, LeRobot's page says 10.
_OF_OPENPI = {"libero_spatial": 98.8, "libero_object": 98.2, "libero_goal": 98.0, "libero_10": 92.4}
_OF_LEROBOT = {"libero_spatial": 97.0, "libero_object": 99.0, "libero_goal": 98.0, "libero_10": 96.0}

PUBLISHED_RATES = (
    PublishedRate(CUBES_POLICY, "cubes", 842, 850, "docs/cubes.md"),
    *(
        PublishedRate("gs://openpi-assets/checkpoints/pi05_libero", suite, round(5 * rate), 500, _OPENPI)
        for suite, rate in _OF_OPENPI.items()
    ),
    *(
        PublishedRate(name, suite, round(rate), 100, _LEROBOT)
        for name in ("lerobot/pi05_libero_finetuned", "lerobot/pi05_libero_finetuned_v044")
        for suite, rate in _OF_LEROBOT.items()
    ),
)
