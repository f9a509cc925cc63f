"""The whole model: from pictures, proprioception and text to a clean latent video, which holds actions and value.

The observer of one network evaluation takes the rows of the recorded frame's queries, and their updates.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from vla_attention.capture.policies.cosmos.config import CosmosConfig
from vla_attention.capture.policies.cosmos.dit import Attention, BlockEditor, BlockObserver, Dit
from vla_attention.capture.policies.cosmos.latents import SELF, condition_mask, cross_layout, fill_frame, self_layout
from vla_attention.capture.policies.cosmos.preprocess import pixels
from vla_attention.capture.policies.cosmos.sampler import flow_time, noise_levels, sample, seeded_noise
from vla_attention.capture.policies.cosmos.vae import CausalEncoder
from vla_attention.capture.recording.attention import (
    AttentionEditor,
    CallKeys,
    LogitChange,
    RowCollector,
    RowSink,
)
from vla_attention.capture.recording.contributions import Projection


@dataclass
class CallObserver:
    """Passes rows and updates of the queries of `query_frame` on to the recorders of the sites.

    Rows and contributions come from the probabilities that the model itself uses; nothing is computed twice.
    """

    denoise_step: int
    query_frame: int
    tokens_per_frame: int
    recorders: Mapping[str, RowCollector]
    #: site -> values and output weight of the current block, until its gates are known
    _seen: dict[str, tuple[Tensor, Tensor]] = field(default_factory=dict, init=False, repr=False)

    @property
    def _queries(self) -> slice:
        return slice(0, self.tokens_per_frame)

    def begin_block(self, layer: int) -> None:
        """Tell the recorders that this block begins."""
        for recorder in self.recorders.values():
            recorder.begin_block(layer, self.denoise_step)

    def rows(self, site: str, layer: int, frame: int, attention: Attention, value: Tensor) -> RowSink | None:
        """Return the function that takes the rows of these queries, or None if they are not recorded."""
        recorder = self.recorders.get(site)
        if frame != self.query_frame or recorder is None:
            return None
        if recorder.update_sink(layer, self.denoise_step, self._queries) is not None:
            self._seen[site] = value, attention.output_proj.weight
        return recorder.sink(layer, self.denoise_step, self._queries)

    def updates(self, layer: int, updates: dict[str, Tensor], gates: dict[str, Tensor], block_input: Tensor) -> None:
        """Pass values, projection and update of the recorded queries on to the recorders."""
        for site, recorder in self.recorders.items():
            sink = recorder.update_sink(layer, self.denoise_step, self._queries)
            if sink is not None:
                value, weight = self._seen.pop(site)
                sink(value, Projection(weight, gates[site][0, self.query_frame]), updates[site][:, self.query_frame])


@dataclass(frozen=True)
class CallEditor:
    """Asks the editors of the sites for the changes of one network evaluation.

    The queries of `query_frame` are the action queries. At `self`, every token is a key too.
    """

    denoise_step: int
    query_frame: int
    tokens_per_frame: int
    editors: Mapping[str, AttentionEditor]

    def change(self, site: str, layer: int, frame: int) -> LogitChange | None:
        """Return the change of the logits (batch, head, query of the frame, key), or None."""
        editor = self.editors.get(site)
        if editor is None:
            return None
        count = self.tokens_per_frame
        action_queries = slice(0, count if frame == self.query_frame else 0)
        own_keys = slice(frame * count, (frame + 1) * count) if site == SELF else None
        return editor.change(layer, self.denoise_step, CallKeys(action_queries, own_keys))


PROPRIO_FRAME = "proprio"


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
        return mask * given + (1 - mask) * clean

    @torch.no_grad()
    def sample_latents(
        self,
        given: Tensor,
        text: Tensor,
        seed: int,
        query_frame: int,
        recorders: Mapping[str, RowCollector] | None,
        editors: Mapping[str, AttentionEditor] | None,
    ) -> Tensor:
        """Return the clean latent video (1, channel, frame, row, column) float32; it does not depend on recorders.

        given: from `given_latents`. text: (1, position, text width). seed: of the noise, made by numpy's legacy
        generator. query_frame: whose queries are the action queries. recorders, editors: of sites.
        """
        config = self.config
        noise = torch.from_numpy(seeded_noise(seed, config.latent_shape)).to(self.device)
        mask = condition_mask(config).to(self.device)
        text = text.to(self.device)

        def denoise(noisy: Tensor, sigma: float, step: int) -> Tensor:
            call = step, query_frame, config.tokens_per_frame
            observer = CallObserver(*call, recorders) if recorders else None
            editor = CallEditor(*call, editors) if editors else None
            return self.denoise(noisy, sigma, given, mask, text, observer, editor)

        return sample(denoise, noise, self.levels)
