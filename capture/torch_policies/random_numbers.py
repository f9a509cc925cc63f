"""torch's random numbers at one moment, so that a policy call can be made again with the same."""

from __future__ import annotations

import torch


class RandomNumbers:
    """The states of torch's random numbers, on the processor and on every GPU, when this was made."""

    def __init__(self) -> None:
        self._cpu = torch.random.get_rng_state()
        count = torch.cuda.device_count() if torch.cuda.is_available() else 0
        self._gpus = [torch.cuda.get_rng_state(device) for device in range(count)]

    def again(self) -> None:
        """Set the states to what they were."""
        torch.random.set_rng_state(self._cpu)
        for device, state in enumerate(self._gpus):
            torch.cuda.set_rng_state(state, device)
