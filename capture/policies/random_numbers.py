"""The random numbers that a policy may draw: kept, and set back, so that a call can be made again."""

from __future__ import annotations

import random

import numpy as np
import torch


class RandomNumbers:
    """The states of torch's random numbers, on the processor and every GPU, of numpy's and Python's, when made."""

    def __init__(self) -> None:
        self._cpu = torch.random.get_rng_state()
        count = torch.cuda.device_count() if torch.cuda.is_available() else 0
        self._numpy = np.random.get_state()  # noqa: NPY002 - what the policy may draw from
        self._python = random.getstate()
        self._gpus = [torch.cuda.get_rng_state(device) for device in range(count)]

    def again(self) -> None:
        """Set the states to what they were."""
        torch.random.set_rng_state(self._cpu)
        np.random.set_state(self._numpy)  # noqa: NPY002
        random.setstate(self._python)
        for device, state in enumerate(self._gpus):
            torch.cuda.set_rng_state(state, device)

    @staticmethod
    def reseed(seed: int) -> None:
        """Let all of them begin at a seed."""
        torch.manual_seed(seed)
        np.random.seed(seed % 2**32)  # noqa: NPY002
        random.seed(seed)
