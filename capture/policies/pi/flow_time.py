"""Flow times of the denoise steps and their embedding, in the two conventions of pi policies.

The fastest wave of the embedding turns by 1571 rad over the unit interval, so the rounding of a time or of a
period changes attention: about 1e-5 from float32 instead of float64 waves, up to 1e-4 from accumulated instead of
stepped times.
"""

from __future__ import annotations

from typing import Literal

import numpy as np
import torch
from torch import Tensor

#: `accumulated`: openpi's JAX model, all in float32, each time the one before plus the step (1, 0.9, 0.79999995, ...).
#: `stepped`: LeRobot's, time 1 + step · dt and waves in float64, both rounded to float32 at the end.
TimeConvention = Literal["accumulated", "stepped"]

#: Shortest and longest period of the time embedding.
MIN_PERIOD, MAX_PERIOD = 4e-3, 4.0


def denoise_times(num_steps: int, convention: TimeConvention = "accumulated") -> np.ndarray:
    """Return the flow times at which the network is evaluated, (denoise,) float32: 1 = noise, towards 0 = action."""
    if convention == "stepped":
        return (1.0 + np.arange(num_steps) * (-1.0 / num_steps)).astype(np.float32)
    step = np.float32(-1.0 / num_steps)
    times = [np.float32(1.0)]
    while len(times) < num_steps:
        times.append(np.float32(times[-1] + step))
    return np.array(times, dtype=np.float32)


def embed_times(
    times: np.ndarray,
    width: int,
    convention: TimeConvention = "accumulated",
    periods: tuple[float, float] = (MIN_PERIOD, MAX_PERIOD),
) -> Tensor:
    """Return [sin, cos] waves of the times (denoise,) as (denoise, width) float32, with geometric periods.

    periods: the shortest and the longest.

    Computed on the CPU, because other devices round the periods differently.
    """
    dtype = torch.float64 if convention == "stepped" else torch.float32
    fraction = torch.linspace(0.0, 1.0, width // 2, dtype=dtype)
    shortest, longest = periods
    period = shortest * (longest / shortest) ** fraction
    angle = torch.from_numpy(times).to(dtype)[:, None] * (1.0 / period * 2.0 * torch.pi)
    return torch.cat([torch.sin(angle), torch.cos(angle)], dim=-1).float()
