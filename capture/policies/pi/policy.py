"""The pi policies behind the policy interface: from observation to action chunk, with the layout of the keys."""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from functools import cached_property

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from vla_attention.capture.environments.base import Observation
from vla_attention.capture.machine import memory_left_on
from vla_attention.capture.policies.identity import PolicySource, describe_policy
from vla_attention.capture.policies.noise import initial_noise, noise_seed
from vla_attention.capture.policies.pi.call_variants import (
    ModelCall,
    call_bytes,
    graph_bytes,
    most_calls,
    sample_variants,
)
from vla_attention.capture.policies.pi.compiled import CompiledSteps
from vla_attention.capture.policies.pi.config import PiConfig
from vla_attention.capture.policies.pi.flow_time import denoise_times
from vla_attention.capture.policies.pi.influence import cut_gradients
from vla_attention.capture.policies.pi.model import PiModel
from vla_attention.capture.policies.pi.preprocess import libero_state, pad_to
from vla_attention.capture.policies.pi.processing import Processing, image_tensor
from vla_attention.capture.policies.pi.tokenizer import (
    PromptTokenizer,
    TokenizedPrompt,
    check_vocabulary,
    clean_instruction,
)
from vla_attention.capture.policies.policy import (
    CallVariant,
    GivenInputs,
    PolicyInput,
    VariantMemory,
    camera_frame,
    map_keys,
)
from vla_attention.capture.policies.weights import dtype_name, weights_digest
from vla_attention.capture.recording.attention import AttentionEditor, BatchCollector, RowCollector
from vla_attention.schemas.errors import BadArgument
from vla_attention.schemas.fitted_pictures import fitted_part, with_borders
from vla_attention.schemas.jsonable import to_json
from vla_attention.schemas.layout import WHOLE, PatchGrid, Role, SiteLayout, Span, SpanKind, roles_from_spans
from vla_attention.schemas.safe_text import visible
from vla_attention.schemas.stores.store_format import PolicyCameraView, PolicyIdentity

PROMPT_SPAN, STATE_SPAN, ACTION_SPAN = "prompt", "state", "actions"


def site_layout(config: PiConfig) -> SiteLayout:
    """Return the key axis of a denoise step: cameras, prompt, state token (pi0 only), actions."""
    parts: list[tuple[str, SpanKind, int]] = [(camera, "image", config.siglip.num_tokens) for camera in config.cameras]
    parts.append((PROMPT_SPAN, "text", config.max_token_len))
    if not config.pi05:
        parts.append((STATE_SPAN, "state", 1))
    parts.append((ACTION_SPAN, "action", config.action_horizon))
    siglip, start, spans = config.siglip, 0, []
    grid = PatchGrid(siglip.grid, siglip.grid, siglip.image_size, siglip.image_size)
    for name, kind, length in parts:
        camera = name if kind == "image" else None
        spans.append(Span(name, kind, start, start + length, camera, grid if camera else None))
        start += length
    return SiteLayout(name="joint", spans=tuple(spans))


class PiPolicy:
    """A pi0 or pi0.5 model with its tokenizer and its processing, for the simulators' arm or a data set's robot."""

    #: Pictures and prompt read each other once, before the denoise steps.
    has_prefix = True

    def __init__(self, model: PiModel, tokenizer: PromptTokenizer, processing: Processing, source: PolicySource):
        config = model.config
        check_vocabulary(tokenizer, config.vocab_size, source.name)
        self.model = model
        self.tokenizer = tokenizer
        self.processing = processing
        self.robot = processing.robot
        self.source = source
        self.name = source.name
        self.family = "pi05" if config.pi05 else "pi0"
        self.sites = (site_layout(config),)
        self.num_layers = config.action_expert.depth
        self.num_heads = config.action_expert.num_heads
        self.num_denoise_steps = config.num_denoise_steps
        self.action_horizon = config.action_horizon
        self.num_action_queries = config.action_horizon
        self.default_protocol = processing.protocol
        self.default_replan_steps = processing.default_replan_steps
        self.cameras: tuple[PolicyCameraView, ...] = tuple(
            PolicyCameraView(name, source=self.robot.cameras[name], upright=True, mirrored=self.robot.turned)
            for name in config.cameras
            if name in self.robot.cameras
        )
        self.needs_camera_frames = not processing.whole_grey_levels
        self._warned: set[str] = set()

    def compile_steps(self) -> None:
        """Make denoise steps by one compiled graph from here on, and say what that takes; see `compiled.py`."""
        self.model.compiled = CompiledSteps(self.model)
        config = self.model.config
        numbers = self.num_layers * config.suffix_len * (self.num_heads * self.sites[0].num_keys)
        print(
            "The denoise steps are compiled at the first policy call, which takes a minute or more. At every step the "
            f"graph gives the rows of all {self.num_layers} layers ({4 * numbers / 1e6:.1f} MB), whether or not they "
            "are recorded.",
            file=sys.stderr,
            flush=True,
        )

    def query_pools(self) -> NDArray[np.float64]:
        """Return the weights (pool, action query): every query is one action step."""
        return np.eye(self.num_action_queries)

    def replan_noise_seed(self, run_seed: int, task_id: int, episode_index: int, replan: int) -> int:
        """Return a different seed for every replan."""
        return noise_seed(run_seed, task_id, episode_index, replan)

    def denoise_times(self) -> NDArray[np.float64]:
        """Return the flow time of each denoise step, (denoise,): 1 = noise, towards 0 = action."""
        return denoise_times(self.num_denoise_steps, self.model.config.time_convention).astype(np.float64)

    @cached_property
    def _digest(self) -> str:
        return weights_digest(self.model)

    def identity(self) -> PolicyIdentity:
        """Return the policy's description for the store. Slow the first time, because it reads all weights."""
        config = self.model.config
        facts = {
            "config": {**asdict(config), "cameras": list(config.cameras)},
            "dtype": dtype_name(self.model.dtype),
            **self.processing.provenance(),
            "prompt_format": self.processing.prompt_format,
            "long_prompts": "cut" if self.processing.cut_long_prompts else "refused",
            "tokenizer_digest": self.tokenizer.digest,
        }
        if self.model.compiled is not None:
            facts["compiled"] = "denoise steps"
        if not self.robot.turned:
            facts["robot"] = to_json(self.robot)
        return describe_policy(self, self.source, self._digest, facts)

    def prepare(self, observation: Observation, instruction: str) -> PolicyInput:
        """Turn an observation and an instruction into the model's input (batch 1)."""
        frames = {camera.name: camera_frame(observation, camera.source) for camera in self.cameras}
        state = libero_state(observation.eef_pos, observation.eef_quat, observation.gripper_qpos)
        return self._prepare_frames(frames, state, instruction)

    def prepare_robot(
        self, pictures: Mapping[str, NDArray[np.uint8]], state: NDArray[np.float64], instruction: str
    ) -> PolicyInput:
        """Turn a frame of a data set into the model's input (batch 1).

        pictures: column -> (height, width, 3) uint8, in the orientation of the data set. state: (state of the robot,).
        """
        if state.shape != (self.robot.state_dim,):
            raise BadArgument(f"The state has the shape {state.shape}; expected ({self.robot.state_dim},).")
        frames = {camera.name: pictures[camera.source] for camera in self.cameras}
        return self._prepare_frames(frames, np.asarray(state, dtype=np.float64), instruction)

    def _prepare_frames(
        self, frames: Mapping[str, NDArray[np.uint8]], state: NDArray[np.float64], instruction: str
    ) -> PolicyInput:
        """Return the model's input of the cameras' own pictures."""
        if not clean_instruction(instruction).strip():
            raise BadArgument(f"The instruction {instruction!r} is empty: a policy needs at least one word.")
        prepared = self.prepare_again(GivenInputs({}, frames, state, instruction))
        return prepared if self.needs_camera_frames else replace(prepared, camera_frames={})

    def prepare_again(self, given: GivenInputs) -> PolicyInput:
        """Turn what a call was given into the model's input (batch 1)."""
        config, device = self.model.config, self.model.device
        size = config.siglip.image_size
        pictures = {
            camera.name: self.processing.pictures_of_frame(given.camera_frames[camera.name], size)
            if camera.name in given.camera_frames
            else (given.frames[camera.name], image_tensor(given.frames[camera.name]))
            for camera in self.cameras
        }
        normalised = self.processing.state.normalise(given.state)
        layout = self.sites[0]
        prompt_span = layout.span(PROMPT_SPAN)
        tokenized = self.tokenizer.tokenize(
            given.instruction,
            max_token_len=config.max_token_len,
            first_key=prompt_span.start,
            state=normalised,
            prompt_format=self.processing.prompt_format,
            cut=self.processing.cut_long_prompts,
        )
        self._warn_of_cut(tokenized, given.instruction)
        shown = {name: part for name, part in given.shown.items() if name not in given.camera_frames}
        shown |= {
            name: part
            for name, picture in given.camera_frames.items()
            if (part := fitted_part((picture.shape[0], picture.shape[1]), (size, size))) != WHOLE
        }
        roles = {camera: Role.IMAGE if camera in pictures else Role.MASKED_IMAGE for camera in config.cameras}
        # The prompt's own roles replace the placeholder below.
        roles |= {PROMPT_SPAN: Role.TEXT, STATE_SPAN: Role.STATE, ACTION_SPAN: Role.ACTION}
        key_role = roles_from_spans(layout, roles)
        key_role[prompt_span.start : prompt_span.stop] = tokenized.roles
        key_role = with_borders(layout, key_role, shown)

        black = torch.full((1, 3, size, size), -1.0)
        # Masks stay in the processor's memory, as `PiModel.sample_actions` wants them.
        tensors: dict[str, Tensor] = {
            "tokens": torch.from_numpy(tokenized.ids)[None].to(device),
            "token_mask": torch.from_numpy(tokenized.mask)[None],
            "state": torch.from_numpy(pad_to(normalised, config.action_dim)).float()[None].to(device),
        }
        for camera in config.cameras:
            tensors[f"image:{camera}"] = (pictures[camera][1] if camera in pictures else black).to(device)
            tensors[f"image_mask:{camera}"] = torch.tensor([camera in pictures])
        frames = {slot: frame for slot, (frame, _) in pictures.items()}
        return PolicyInput(
            frames=frames,
            key_role={layout.name: key_role},
            prompt=tokenized.prompt,
            state=given.state,
            tensors=tensors,
            camera_frames=given.camera_frames,
            shown=shown,
        )

    def _warn_of_cut(self, tokenized: TokenizedPrompt, instruction: str) -> None:
        """Warn once per instruction that its prompt was cut. In the store, the text is longer than its pieces."""
        if not tokenized.num_cut or instruction in self._warned:
            return
        self._warned.add(instruction)
        pieces = tokenized.prompt.pieces
        lost = tokenized.prompt.text[pieces[-1].stop if pieces else 0 :]
        print(
            f"Warning: the prompt of '{visible(instruction)}' has {tokenized.num_cut} tokens more than the policy's "
            f"{len(tokenized.ids)} slots; they are cut as the reference implementation does, and the policy never "
            f"reads {lost!r}.",
            file=sys.stderr,
            flush=True,
        )

    def act(
        self,
        policy_input: PolicyInput,
        noise_seed: int,
        recorders: Mapping[str, RowCollector] | None = None,
        editors: Mapping[str, AttentionEditor] | None = None,
    ) -> NDArray[np.float64]:
        """Return the action chunk (horizon, action dim) for the robot; the noise depends on `noise_seed` only."""
        site = self.sites[0].name
        sampled = self._sample(
            policy_input.tensors, [noise_seed], (recorders or {}).get(site), (editors or {}).get(site)
        )
        return self.processing.environment_actions(sampled[0], policy_input.state)

    def act_batch(
        self,
        policy_inputs: Sequence[PolicyInput],
        noise_seeds: Sequence[int],
        recorders: Sequence[Mapping[str, RowCollector]],
    ) -> list[NDArray[np.float64]]:
        """Make several calls as one batch; see `BatchPolicy`."""
        site = self.sites[0].name
        tensors = {name: torch.cat([each.tensors[name] for each in policy_inputs]) for name in policy_inputs[0].tensors}
        collector = BatchCollector([each[site] for each in recorders]) if all(site in r for r in recorders) else None
        sampled = self._sample(tensors, noise_seeds, collector, None)
        return [
            self.processing.environment_actions(actions, each.state)
            for actions, each in zip(sampled, policy_inputs, strict=True)
        ]

    def act_variants(self, variants: Sequence[CallVariant], num_steps: int, batch: int) -> list[NDArray[np.float64]]:
        """Make variants of one call together; see `VariantPolicy`."""
        site = self.sites[0].name
        calls = [
            ModelCall(
                each.policy_input.tensors,
                self._noise([each.noise_seed]),
                each.editors.get(site),
            )
            for each in variants
        ]
        sampled = sample_variants(self.model, calls, num_steps, batch).cpu().numpy()
        return [
            self.processing.environment_actions(actions, each.policy_input.state)
            for actions, each in zip(sampled, variants, strict=True)
        ]

    def patch_gradients(
        self, policy_input: PolicyInput, noise_seed: int, directions: NDArray[np.float32]
    ) -> NDArray[np.float32]:
        """Return the first order of knock-outs; see `MapPolicy`."""
        noise, model = self._noise([noise_seed]), self.model
        sums = torch.zeros((len(directions), *noise.shape[1:]), device=model.device)
        sums[..., : directions.shape[-1]] = torch.from_numpy(directions).to(model.device)
        found = cut_gradients(model, policy_input.tensors, noise, sums, model.config.num_denoise_steps)
        gradients: NDArray[np.float32] = found[:, list(map_keys(self))].cpu().numpy()
        return gradients

    def gradient_memory(self) -> int:
        """Return the bytes that the graph of `patch_gradients` takes, about."""
        return graph_bytes(self.model.config, self.model.dtype.itemsize)

    def _noise(self, seeds: Sequence[int]) -> Tensor:
        """Return the noise (call, horizon, action dim) of calls, each from its seed."""
        shape = (1, self.model.config.action_horizon, self.model.config.action_dim)
        noise = np.concatenate([initial_noise(seed, shape) for seed in seeds])
        return torch.from_numpy(noise).to(self.model.device)

    def variant_memory(self) -> VariantMemory:
        """Return how much memory variants take, and how much is left for them."""
        config, device = self.model.config, self.model.device
        number = self.model.dtype.itemsize
        return VariantMemory(
            call_bytes(config, number),
            most_calls(config, config.prefix_len, device),
            memory_left_on(device),
            str(device),
        )

    def action_units(self) -> NDArray[np.float64]:
        """Return how far 1 of the model's normalised actions moves the robot, (action dim,), in the robot's units."""
        at_rest = np.zeros((2, self.model.config.action_dim))
        at_rest[1] = 1.0
        low, high = self.processing.environment_actions(at_rest, np.zeros(self.robot.state_dim))
        units: NDArray[np.float64] = high - low
        return units

    def _sample(
        self,
        tensors: Mapping[str, Tensor],
        noise_seeds: Sequence[int],
        recorder: RowCollector | None,
        editor: AttentionEditor | None,
    ) -> NDArray[np.float32]:
        """Return the model's actions (batch, horizon, action dim), still normalised."""
        config = self.model.config
        sampled = self.model.sample_actions(
            images={camera: tensors[f"image:{camera}"] for camera in config.cameras},
            image_masks={camera: tensors[f"image_mask:{camera}"] for camera in config.cameras},
            tokens=tensors["tokens"],
            token_mask=tensors["token_mask"],
            state=tensors["state"],
            noise=self._noise(noise_seeds),
            recorder=recorder,
            editor=editor,
        )
        actions: NDArray[np.float32] = sampled.cpu().numpy()
        return actions
