"""Sizes and conventions of a Cosmos policy: the network, the image encoder, the latent frames, the sampler."""

from __future__ import annotations

from dataclasses import dataclass, field

from vla_attention.schemas.errors import BadArgument, look_up, unknown_name

#: Positions of the text encoder. Positions after the real tokens are exactly 0; the embedding of a real token never is.
TEXT_LENGTH = 512


@dataclass(frozen=True)
class DitConfig:
    """Sizes of the diffusion transformer; the defaults are Cosmos-Predict2 2B as Cosmos Policy uses it.

    in_channels: latent channels; the network appends the condition mask and the padding mask.
    rope_*_extrapolation: factors of the rotary frequencies per axis, which no checkpoint states.
    """

    width: int = 2048
    num_blocks: int = 28
    num_heads: int = 16
    mlp_dim: int = 8192
    text_dim: int = 1024
    adaln_dim: int = 256
    in_channels: int = 16
    out_channels: int = 16
    patch_size: int = 2
    max_positions: int = 128
    rope_t_extrapolation: float = 1.0
    rope_h_extrapolation: float = 3.0
    rope_w_extrapolation: float = 3.0

    def __post_init__(self) -> None:
        if self.width % self.num_heads:
            raise BadArgument(f"A width of {self.width} cannot be split into {self.num_heads} heads.")
        if self.head_dim % 2 or self.spatial_rotary_dim < 4 or self.temporal_rotary_dim < 4:
            raise BadArgument(
                f"A head of {self.head_dim} numbers is too narrow for rotary positions of three axes; expected an even "
                "number of at least 12."
            )

    @property
    def head_dim(self) -> int:
        """Numbers of one attention head."""
        return self.width // self.num_heads

    @property
    def spatial_rotary_dim(self) -> int:
        """Numbers of a head that turn with the row, and as many with the column."""
        return self.head_dim // 6 * 2

    @property
    def temporal_rotary_dim(self) -> int:
        """Numbers of a head that turn with the latent frame."""
        return self.head_dim - 2 * self.spatial_rotary_dim

    def grid(self, latent_height: int, latent_width: int) -> tuple[int, int]:
        """Return the rows and columns of tokens of one latent frame; the latent must be a whole number of patches."""
        patch = self.patch_size
        if latent_height % patch or latent_width % patch or not latent_height or not latent_width:
            raise BadArgument(
                f"A latent frame of {latent_height} x {latent_width} cannot be cut into patches of {patch} x {patch}: "
                f"both sides must be multiples of {patch}."
            )
        rows, columns = latent_height // patch, latent_width // patch
        if max(rows, columns) > self.max_positions:
            raise BadArgument(
                f"A latent frame of {rows} x {columns} tokens is larger than the {self.max_positions} positions of "
                "the network."
            )
        return rows, columns


@dataclass(frozen=True)
class VaeConfig:
    """Sizes of the Wan2.1 image encoder; the defaults are the published one."""

    base_dim: int = 96
    latent_channels: int = 16
    dim_mult: tuple[int, ...] = (1, 2, 4, 4)
    num_res_blocks: int = 2
    temporal_downsample: tuple[bool, ...] = (False, True, True)

    @property
    def spatial_compression(self) -> int:
        """Pixels of one latent cell's side."""
        return 1 << (len(self.dim_mult) - 1)


#: Content of the nine latent frames of the LIBERO policy. `frameN` is another name of each of them.
LIBERO_FRAMES = (
    "blank",
    "proprio",
    "wrist",
    "primary",
    "action",
    "future_proprio",
    "future_wrist",
    "future_primary",
    "value",
)


@dataclass(frozen=True)
class FrameConfig:
    """The latent frames: the content of each, and how many of the first are given instead of denoised."""

    names: tuple[str, ...] = LIBERO_FRAMES
    num_conditioned: int = 4

    @property
    def count(self) -> int:
        """Number of latent frames."""
        return len(self.names)

    def index(self, name: str) -> int:
        """Return a frame's number by its name, as `frameN`, or as `curr_last` (the last given frame).

        Raises `UnknownName` with the names of all frames.
        """
        if name == "curr_last":
            return self.num_conditioned - 1
        number = name.removeprefix("frame")
        if name != number and number.isdecimal() and int(number) < self.count:
            return int(number)
        if name in self.names:
            return self.names.index(name)
        numbers = f"frame0 to frame{self.count - 1}"
        raise unknown_name("latent frame", name, (*self.names, "curr_last", numbers))


@dataclass(frozen=True)
class SamplerConfig:
    """The denoising schedule: `num_steps` network evaluations from sigma_max to sigma_min."""

    num_steps: int = 5
    sigma_max: float = 80.0
    sigma_min: float = 4.0
    rho: float = 7.0


@dataclass(frozen=True)
class CosmosConfig:
    """Everything that determines a Cosmos policy except its weights and statistics."""

    dit: DitConfig = field(default_factory=DitConfig)
    vae: VaeConfig = field(default_factory=VaeConfig)
    frames: FrameConfig = field(default_factory=FrameConfig)
    sampler: SamplerConfig = field(default_factory=SamplerConfig)
    image_size: int = 224
    text_length: int = TEXT_LENGTH
    chunk_size: int = 16
    action_dim: int = 7
    proprio_dim: int = 9

    def __post_init__(self) -> None:
        if self.chunk_size < 1:
            raise BadArgument(f"Cannot use --chunk-size {self.chunk_size}; expected at least 1.")
        if self.sampler.num_steps < 1:
            raise BadArgument(f"Cannot use --num-denoising-steps-action {self.sampler.num_steps}; expected at least 1.")
        if self.image_size % self.vae.spatial_compression:
            raise BadArgument(
                f"An image of {self.image_size} pixels is not a whole number of the {self.vae.spatial_compression} "
                "pixels of a latent cell."
            )
        self.dit.grid(self.latent_size, self.latent_size)
        elements = self.dit.in_channels * self.latent_size**2
        if self.chunk_size * self.action_dim > elements:
            raise BadArgument(
                f"{self.chunk_size} actions of {self.action_dim} numbers do not fit into a latent frame of {elements}; "
                "give a smaller --chunk-size."
            )

    @property
    def latent_size(self) -> int:
        """Cells along one side of a latent frame."""
        return self.image_size // self.vae.spatial_compression

    @property
    def tokens_per_frame(self) -> int:
        """Tokens of one latent frame."""
        rows, columns = self.dit.grid(self.latent_size, self.latent_size)
        return rows * columns

    @property
    def latent_shape(self) -> tuple[int, int, int, int, int]:
        """Shape of the latent video: (1, channel, frame, row, column)."""
        return (1, self.dit.in_channels, self.frames.count, self.latent_size, self.latent_size)


DEFAULT_CONFIG_NAME = "cosmos_predict2_2b_480p_libero__inference_only"

#: Full-size policies by the reference's names. Frames and ranges are those of the LIBERO policy.
NAMED_CONFIGS: dict[str, CosmosConfig] = {DEFAULT_CONFIG_NAME: CosmosConfig()}


def find_config(name: str) -> CosmosConfig:
    """Return a full-size configuration by the reference's name for it."""
    return look_up("Cosmos configuration", name, NAMED_CONFIGS)
