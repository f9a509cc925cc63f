"""The whole model: from pictures, proprioception and text to a clean latent video, which holds actions and value."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from vla_attention.capture.policies.cosmos.config import CosmosConfig
from vla_attention.capture.policies.cosmos.dit import BlockEditor, BlockObserver, Dit
from vla_attention.capture.policies.cosmos.latents import condition_mask, fill_frame
from vla_attention.capture.policies.cosmos.layout import cross_layout, self_layout
from vla_attention.capture.policies.cosmos.observer import CallEditor, CallObserver
from vla_attention.capture.policies.cosmos.preprocess import pixels
from vla_attention.capture.policies.cosmos.sampler import flow_time, noise_levels, sample, seeded_noise
from vla_attention.capture.policies.cosmos.vae import CausalEncoder
from vla_attention.capture.recording.attention import AttentionEditor, RowCollector

PROPRIO_FRAME = "proprio"


@dataclass
class CallTrace:
    """Inputs and outputs of each network evaluation, kept for a comparison with the reference only."""

    noisy: list[Tensor] = field(default_factory=list)
    net_input: list[Tensor] = field(default_factory=list)
    times: list[Tensor] = field(default_factory=list)
    net_output: list[Tensor] = field(default_factory=list)
    clean: list[Tensor] = field(default_factory=list)


@dataclass(frozen=True)
class Recorders:
    """The row collector of each site, and the latent frame whose queries they get. Sampling does not depend on them.

    editors: the editor of each site whose attention changes; for them the queries of that frame are the action queries.
    """

    rows: Mapping[str, RowCollector] = field(default_factory=dict)
    query_frame: int = 4
    editors: Mapping[str, AttentionEditor] = field(default_factory=dict)


class CosmosModel(nn.Module):
    """Transformer and image encoder, with their sizes and conventions."""

    def __init__(self, config: CosmosConfig, dit: Dit, encoder: CausalEncoder):
        super().__init__()
        self.config = config
        self.dit = dit
        self.encoder = encoder
        self.sites = (self_layout(config), cross_layout(config))

    @property
    def dtype(self) -> torch.dtype:
        """Precision of the transformer's weights."""
        return self.dit.dtype

    @property
    def device(self) -> torch.device:
        """Device of the weights."""
        return self.dit.device

    @property
    def levels(self) -> NDArray[np.float64]:
        """The noise level of each network evaluation."""
        return noise_levels(self.config.sampler)

    @torch.no_grad()
    def given_latents(self, pictures: Sequence[NDArray[np.uint8]], proprio: NDArray[np.float64]) -> Tensor:
        """Return the given latent frames (1, channel, frame, row, column) float32; frames to be denoised are 0.

        `pictures` in the order of the frames (wrist, primary); `proprio` is normalised, and rounded to bfloat16 here as
        in the reference.
        """
        config = self.config
        images = [pixels(picture, self.encoder.dtype, self.encoder.device) for picture in pictures]
        encoded = self.encoder.encode(images)
        latents = torch.zeros(config.latent_shape, device=self.device)
        latents[:, :, : encoded.shape[2]] = encoded.to(self.device)
        rounded = torch.from_numpy(np.asarray(proprio)).to(torch.bfloat16).float().to(self.device)
        _, channels, _, height, width = config.latent_shape
        latents[0, :, config.frames.index(PROPRIO_FRAME)] = fill_frame(rounded, (channels, height, width))
        return latents

    def denoise(
        self,
        noisy: Tensor,
        sigma: float,
        given: Tensor,
        mask: Tensor,
        text: Tensor,
        observer: BlockObserver | None = None,
        trace: CallTrace | None = None,
        editor: BlockEditor | None = None,
    ) -> Tensor:
        """Return the estimate of the clean latents (float32) from latents with noise `sigma`; given frames are kept."""
        t = torch.tensor(flow_time(sigma), dtype=torch.float32, device=noisy.device)
        net_input = mask * given + (1 - mask) * ((1 - t) * noisy)
        times = t * (1 - mask[:, 0, :, 0, 0])
        size = self.config.image_size
        padding = torch.zeros(len(noisy), 1, size, size, device=noisy.device)
        net_output = self.dit(net_input, times, mask, padding, text, observer, editor).float()
        clean: Tensor = (1 - t) * noisy - t * net_output
        clean = mask * given + (1 - mask) * clean
        if trace is not None:
            trace.noisy.append(noisy)
            trace.net_input.append(net_input)
            trace.times.append(times.to(self.dtype).float())
            trace.net_output.append(net_output)
            trace.clean.append(clean)
        return clean

    @torch.no_grad()
    def sample_latents(
        self, given: Tensor, text: Tensor, seed: int, recorders: Recorders | None = None, trace: CallTrace | None = None
    ) -> Tensor:
        """Return the clean latent video (1, channel, frame, row, column) float32.

        given: from `given_latents`. text: (1, position, text width). seed: of the noise, made by numpy's legacy
        generator.
        """
        config = self.config
        noise = torch.from_numpy(seeded_noise(seed, config.latent_shape)).to(self.device)
        mask = condition_mask(config).to(self.device)
        text = text.to(self.device)

        def denoise(noisy: Tensor, sigma: float, step: int) -> Tensor:
            observer, editor = self._observer(recorders, step), self._editor(recorders, step)
            return self.denoise(noisy, sigma, given, mask, text, observer, trace, editor)

        return sample(denoise, noise, self.levels)

    def _observer(self, recorders: Recorders | None, step: int) -> CallObserver | None:
        if recorders is None or not recorders.rows:
            return None
        return CallObserver(
            denoise_step=step,
            query_frame=recorders.query_frame,
            tokens_per_frame=self.config.tokens_per_frame,
            recorders=recorders.rows,
        )

    def _editor(self, recorders: Recorders | None, step: int) -> CallEditor | None:
        if recorders is None or not recorders.editors:
            return None
        return CallEditor(
            denoise_step=step,
            query_frame=recorders.query_frame,
            tokens_per_frame=self.config.tokens_per_frame,
            editors=recorders.editors,
        )
