"""The store format: its version, the names, axes and attributes of `NAME.zarr`, and its errors. No I/O here.

Nothing here changes once a release wrote it (`docs/store.md`, "Versions"). After a change before that, write the JSON
Schema files, the example stores and the golden stores again.

NAME.zarr/                            attributes: `RootAttributes`
  episodes/task003_episode007/        attributes: `EpisodeAttributes`; listed = complete
    joint/                            attributes: the numbers of its recorded layers, denoise steps and heads
    joint/rows                        (replan, layer, denoise, head, query, key) float16 of p x 2^15, or float32
    joint/atoms                       (replan, layer, denoise, head, query, segment) float32; last the whole row
    joint/uniform                     as `rows`, float32; an axis along which nothing changes has length 1; only where
                                      the roles do not say it
    joint/key_role                    (replan, key) uint8
    state                             (replan, state_dim); only where it is known
    actions                           (replan, horizon, action_dim), as given to the environment; only where known
    dataset_actions                   (replan, horizon, action_dim), those of the data set; only where there are some
    base_actions                      (replan, horizon, action_dim), those of its base; in a rerun with interventions
    frames/<camera>                   (replan, row, column, channel) uint8, as the model sees it
    camera_frames/<camera>            the same, as the camera gave it; only where `frames` is a rounded model input
    objects/<camera>                  (replan, patch, object) float32
    effects/change                    (entry, horizon, action_dim) float32; only where effects were measured
    effects/map                       (map_row, block) float32; only with a map of patches, as the next
    effects/patch_change              (map_entry, horizon, action_dim) float32
    joint/cut                         (entry, key) float32, the weight of each key that an effect is without
    steps/poses                       (moment, body, pose) float32; only where a simulator of ours ran the episode
    steps/gripper                     (moment, finger) float32
    steps/actions                     (step, action_dim) float32, those that were executed
    seal/                             attributes: `EpisodeSeal`, which binds all of the above
"""

from __future__ import annotations

import re
from typing import Annotated, Any, Literal, NamedTuple

from msgspec import Meta, field
from msgspec.structs import replace

from vla_attention.schemas.effects import EffectsRecorded, EpisodeEffects
from vla_attention.schemas.episode_steps import EpisodeSteps
from vla_attention.schemas.errors import BadArgument, UserError, listing, unknown_name
from vla_attention.schemas.groupings.vocabulary import SceneObject
from vla_attention.schemas.interventions import Interventions, RerunSource
from vla_attention.schemas.jsonable import Document, Number
from vla_attention.schemas.layout import Part, Prompt, SiteLayout
from vla_attention.schemas.plumbing import Plumbing
from vla_attention.schemas.safe_text import check_inner_path, check_name, check_text
from vla_attention.schemas.segments import Segment

FORMAT_NAME = "vla-attention"
#: The root attribute `store_version`; no other one is read.
STORE_VERSION = 1
STORE_SUFFIX = ".zarr"
EPISODES_GROUP = "episodes"
#: The document of that group. It states nothing but that it is a group.
EPISODES_DOCUMENT = f"{EPISODES_GROUP}/zarr.json"

ROW_AXES = ("replan", "layer", "denoise", "head", "query", "key")
ATOM_AXES = (*ROW_AXES[:-1], "segment")
#: Parts are the episode's segments in order, then the block's whole attention update.
CONTRIBUTION_AXES = ("replan", "layer", "denoise", "part", "other_part")

#: Fields of `EpisodeAttributes` that are numbers of each replan or denoise step, and their types.
NUMBERS = {
    "env_step": "int32",
    "prompt_index": "int32",
    "noise_seed": "int64",
    "dataset_action_count": "int32",
    "denoise_time": "float32",
}

#: The group of an episode whose attributes are an `EpisodeSeal`.
SEAL_GROUP = "seal"

#: Numbers of up to twelve digits.
_EPISODE_NAME = re.compile(r"task([0-9]{3,12})_episode([0-9]{3,12})")


class StoreError(UserError, ValueError):
    """What is at the path of a store cannot be used as one."""


class StoreNotFound(StoreError, FileNotFoundError):
    """No store at the given path."""


class StoreExists(StoreError, FileExistsError):
    """A store exists already, and the run is neither to resume nor to overwrite it."""


class FormatTooNew(StoreError):
    """The store was written by a later format version."""


class RunMismatch(StoreError):
    """A store cannot be continued because its run was configured differently."""


class CorruptEpisode(StoreError):
    """An episode whose content does not agree with its attributes or its seal.

    `file` is the path in the episode of the one file that does not, where one is known.
    """

    def __init__(self, message: str, file: str | None = None) -> None:
        super().__init__(message)
        self.file = file


class Problem(NamedTuple):
    """What is wrong with an episode: a sentence, and the path of the one file that is wrong, where it is known."""

    text: str
    file: str | None = None


class Recording(Document, frozen=True):
    """What of the attention is recorded.

    `layers` are block indices; `layer_labels` are the numbers that the user typed for them (the same unless the
    reference's recorded-call numbers were used; a block that was given both ways has two). `queries` is `mean` (over
    the action queries), `steps` (`num_pools` weighted means of them, one per action step or per step and dimension) or
    `all`. `mantissa_bits` is the precision of the rows (23 = exact). `contributions`: the Gram matrix of value-weighted
    contributions, mean over the action queries, is recorded too. `effects`: which are measured; None: none.
    """

    layers: tuple[int, ...]
    layer_labels: tuple[int, ...]
    denoise_steps: tuple[int, ...]
    heads: tuple[int, ...]
    queries: Literal["mean", "steps", "all"]
    num_action_queries: int
    mantissa_bits: int
    frames: bool = True
    contributions: bool = False
    num_pools: int = 0
    effects: EffectsRecorded | None = None

    @property
    def num_queries(self) -> int:
        """Length of the query axis."""
        return {"mean": 1, "steps": self.num_pools, "all": self.num_action_queries}[self.queries]

    @property
    def axis_numbers(self) -> dict[str, tuple[int, ...]]:
        """What the indices of the axes layer, denoise and head stand for: the attributes of a site's group."""
        return {"layer": self.layers, "denoise": self.denoise_steps, "head": self.heads}

    def of_site(self, site: SiteLayout) -> Recording:
        """What is recorded of one site: the layers and heads that it has, and its own number of action queries.

        Raises:
            BadArgument: none of the recorded layers or heads has this site.
        """
        if not (site.layers or site.heads or site.num_action_queries):
            return self
        layers = tuple(layer for layer in self.layers if not site.layers or layer in site.layers)
        heads = tuple(head for head in self.heads if not site.heads or head < site.heads)
        if not layers:
            raise BadArgument(
                f"Site '{site.name}' is in none of the recorded layers {listing(self.layers, 40)}; it is in layers "
                f"{listing(site.layers, 40)}."
            )
        if not heads:
            raise BadArgument(
                f"Site '{site.name}' has none of the recorded heads {listing(self.heads, 40)}; it has heads 0 to "
                f"{site.heads - 1}."
            )
        # Numbers of recorded calls stand for blocks in families whose sites are in all of them.
        labels = self.layer_labels if layers == self.layers else layers
        return replace(
            self,
            layers=layers,
            layer_labels=labels,
            heads=heads,
            num_action_queries=site.num_action_queries or self.num_action_queries,
        )


#: Names of protocols of runs whose loop is not ours: the caller's own, and a replayed data set.
OTHER_LOOPS = ("recorded", "dataset")
#: What the checkpoint format says of policies that the caller's own code loaded, and vla-attention capture cannot load.
CALLERS_MODULES = "torch modules of the caller"


class Protocol(Document, frozen=True):
    """How episodes are run. It is the same for all episodes of a run.

    `name` is the published evaluation that is followed (openpi, lerobot or cosmos): it decides how resets are seeded.
    `image_size` is the height and width of the simulator's pictures in pixels. `docs/my-checkpoint.md` has the details.

    Runs without a simulator of ours have the name `recorded` (the caller's own loop) or `dataset` (a replayed data
    set); `suite` is the caller's name for the tasks, and a number that is not known is 0.

    `exchanged`: every episode begins in the scene and initial state of one task and is told the sentence of another
    (or of the same), whose goal decides on its success. It is an episode of the told task.
    """

    name: str
    suite: str
    seed: int
    wait_steps: int
    replan_steps: int
    max_steps: int
    image_size: int
    exchanged: bool = False

    def __post_init__(self) -> None:
        """Check the suite's name."""
        check_name("suite", self.suite)

    @property
    def of_other_loop(self) -> bool:
        """Whether the loop is not ours: state, actions, noise seeds and some numbers may then be unknown."""
        return self.name in OTHER_LOOPS


class PolicyCameraView(Document, frozen=True):
    """How a policy camera's picture came from the simulator's.

    The simulators give the bottom row first. `upright`: rows were reversed, so that row 0 of the stored frame is the
    top of the scene. `mirrored`: columns were reversed, so that column 0 is the scene's right edge. `visible`: the
    model sees the middle of the picture, this fraction of its side.
    """

    name: str
    source: str
    upright: bool
    mirrored: bool
    visible: Number = 1.0

    def __post_init__(self) -> None:
        """Check the names."""
        check_name("camera", self.name)
        check_name("camera", self.source)


class PolicyIdentity(Document, frozen=True):
    """Which policy ran. `digest` is over the weights; `config` has what else distinguishes policies of its family."""

    name: str
    family: str
    checkpoint: str
    checkpoint_format: str
    digest: str
    untrained: bool
    num_layers: int
    num_heads: int
    num_denoise_steps: int
    action_horizon: int
    cameras: tuple[PolicyCameraView, ...]
    config: dict[str, Any]

    def __post_init__(self) -> None:
        """Check that names and addresses are text of one line."""
        for name in ("name", "family", "checkpoint", "checkpoint_format", "digest"):
            check_text(f"policy's {name}", getattr(self, name))


class DataSetSource(Document, frozen=True):
    """The data set on whose frames a run called its policy.

    `name`: of its folder, or ORG/NAME of the hub. `version`: of its format. `fps`: frames per second. `digest`: over
    its columns, tasks and episodes. `columns`: which columns the policy's cameras, state and actions are, in words.
    `action_names`: how the data set calls the dimensions of its actions; empty where it does not.
    """

    name: str
    version: str
    fps: Number
    robot_type: str
    digest: str
    columns: dict[str, str]
    action_names: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        """Check that the texts are text of one line."""
        texts = (self.name, self.version, self.robot_type, *self.columns, *self.columns.values(), *self.action_names)
        for text in texts:
            check_text("data set's text", text)

    def describe(self) -> str:
        """The data set and the columns that were read, in one line."""
        columns = "; ".join(f"{what} = {column}" for what, column in self.columns.items())
        return (
            f"{self.name}, LeRobotDataset {self.version}, {self.fps:g} frames per second, robot {self.robot_type}; "
            f"{columns}"
        )


class RootAttributes(Document, frozen=True):
    """Attributes of the store's root group: the run's identity. The same for every process that adds episodes.

    All of it is the run's configuration, except the fields in `JOB_RECORDS`. `interventions` says what the run changed
    in the policy and its input, `rerun_of` which store's policy calls it repeated. `data_set` is the one that was
    replayed; None for every other run. `digest` is the sha256 of the other attributes (`root_digest`), which is made
    when the root is written: `verify` compares it.
    """

    format: str
    store_version: int
    policy: PolicyIdentity
    protocol: Protocol
    recording: Recording
    sites: tuple[SiteLayout, ...]
    provenance: dict[str, str]
    interventions: Interventions = Interventions()
    rerun_of: RerunSource | None = None
    data_set: DataSetSource | None = None
    digest: str = ""

    def __post_init__(self) -> None:
        """Check that sites have different names, and that something of each is recorded."""
        names = [site.name for site in self.sites]
        if len(set(names)) != len(names):
            raise BadArgument(f"The sites {listing(names)} do not have different names.")
        for site in self.sites:
            self.recording.of_site(site)

    def site(self, name: str) -> SiteLayout:
        """The site of that name; the error lists the existing ones."""
        for site in self.sites:
            if site.name == name:
                return site
        raise unknown_name("site", name, [site.name for site in self.sites])

    def recording_of(self, site: str) -> Recording:
        """What is recorded of a site, see `Recording.of_site`."""
        return self.recording.of_site(self.site(site))


#: Paths of the fields of `RootAttributes` that describe the job which made the store, not the run's configuration:
#: another job, on another machine, may add episodes. The checkpoint's path is one; the digest of its weights is not.
#: `digest` is over these, too.
JOB_RECORDS = (("provenance",), ("policy", "checkpoint"), ("digest",))


class ArrayRecord(Document, frozen=True):
    """Shape of an array and sha256 of its values (C order, little endian), with which `verify` compares it."""

    shape: tuple[int, ...]
    sha256: str


class EpisodeAttributes(Document, frozen=True):
    """Attributes of one episode's group.

    `success` is None where nobody knows it. `num_steps` is the number of actions executed after the waiting steps, with
    the one that solved the task; 0 where it is not known. The instruction and the prompts are any text; what is shown
    of them is made `safe_text.visible`.

    `task_family`: what tasks of one sentence template share; empty where nobody knows it. `effects`: what the arrays of
    effects are of; None where none were measured. `steps`: the same of the arrays of steps; None where no simulator of
    ours ran the episode. `scene_task_id`: the task whose scene and initial state an exchanged episode began with; None
    for an episode that began with its own. `plumbing`: of the first planned episode of each
    task, or of the first one of a new store. `shown`: camera -> the part (top, left, height, width) of its frames that
    shows its picture, in fractions, where the rest is a border.

    `NUMBERS` are of each replan, and the noise level or flow time of each recorded denoise step; `env_step` counts the
    waiting steps too, `prompt_index` is the number of a prompt, `dataset_action_count` how many of `dataset_actions`
    there are. Empty where they are not known.
    """

    task_id: int
    task_name: str
    instruction: str
    episode_index: int
    initial_state_index: int
    initial_state_digest: str
    success: bool | None
    num_steps: int
    num_replans: int
    prompts: tuple[Prompt, ...]
    segments: dict[str, tuple[Segment, ...]]
    objects: tuple[SceneObject, ...]
    provenance: dict[str, str]
    arrays: dict[str, ArrayRecord]
    env_step: tuple[int, ...] = ()
    prompt_index: tuple[int, ...] = ()
    noise_seed: tuple[int, ...] = ()
    dataset_action_count: tuple[int, ...] = ()
    denoise_time: tuple[Number, ...] = ()
    task_family: str = ""
    effects: EpisodeEffects | None = None
    steps: EpisodeSteps | None = None
    scene_task_id: int | None = None
    plumbing: Plumbing | None = None
    shown: dict[str, Part] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Check the task's name, and the names of arrays, which are paths."""
        check_name("task", self.task_name)
        check_text("task's family", self.task_family)
        for path in self.arrays:
            check_inner_path(path)


def episode_name(task_id: int, episode_index: int) -> str:
    """Name of an episode's group, for instance `task003_episode007`."""
    return f"task{task_id:03d}_episode{episode_index:03d}"


def parse_episode_name(name: str) -> tuple[int, int]:
    """Task id and episode index of an episode's group name."""
    match = _EPISODE_NAME.fullmatch(name)
    if match is None:
        raise BadArgument(f"'{name}' is no episode name; expected for instance {episode_name(3, 7)}.")
    return int(match[1]), int(match[2])


def is_episode_name(name: str) -> bool:
    """Whether a name is that of an episode's group, written as `episode_name` writes it."""
    try:
        return name == episode_name(*parse_episode_name(name))
    except ValueError:
        return False


class FileRecord(Document, frozen=True):
    """Size in bytes and sha256 of a file of an episode.

    Of a shard, from which single chunks are read, `index` is the sha256 of the index at its end, with its checksum, and
    `chunks` the checksums (crc32c) of its chunks, eight digits each: two episodes may have equal indices.
    """

    size: int
    sha256: str
    index: str = ""
    chunks: Annotated[str, Meta(pattern="^([0-9a-f]{8})*$")] = ""


class EpisodeSeal(Document, frozen=True):
    """What binds every file of an episode to the episode's name and to its run.

    `episode` is the name of the episode's group, `run` the digest of the run's configuration (`run_digest`), `files`
    every file of the episode but the seal itself, by its path. `documents` repeats what each `zarr.json` among them
    says, so that one small file opens an episode. `copied_from` is the digest of the captured episode's seal, in a copy
    that leaves something out. `digest` is the sha256 of the seal's file without the 64 digits of this digest.
    """

    episode: str
    run: str
    files: dict[str, FileRecord]
    documents: dict[str, Any]
    digest: str
    copied_from: str = ""

    def __post_init__(self) -> None:
        """Check the paths: a seal lists files inside of its episode's folder."""
        for path in self.files:
            check_inner_path(path)
