"""Effects that a run measures at its policy calls: how the action changes without a word, a part, a picture.

Each is what a rerun with one intervention would have given. The call is made again with keys that are cut off, with
another word, picture or noise; the robot executes the unchanged call. `docs/effects.md` has the definitions.
"""

from __future__ import annotations

from collections import Counter
from typing import Literal

from msgspec import field

from vla_attention.schemas.errors import BadArgument
from vla_attention.schemas.interventions import Interventions, PromptChange, PromptKind
from vla_attention.schemas.jsonable import Document, Number
from vla_attention.schemas.safe_text import visible

#: Changes of actions under the conditions of `EpisodeEffects`; below each site, the weights of the keys cut for them.
CHANGE = "effects/change"
CUT = "cut"
#: What `EffectMap` is of: the order of all patches by first order, and the exact changes without single ones.
MAP, PATCH_CHANGE = "effects/map", "effects/patch_change"
#: What is taken away, one at a time. `text`: every word of the instruction, every part of the prompt, and all of it.
#: `cameras`: every camera's picture, and all of them. `objects`: the patches of every object. `tokens`: every key of
#: the prompt that is no piece of a word. `groups`: every group of a grouping, and everything but the group. `prompts`:
#: the instruction, exchanged for every other sentence of a table. `map`: every patch, see `EffectMap`.
EffectItems = Literal["text", "cameras", "objects", "tokens", "groups", "prompts", "map"]
#: How a map takes something of the pictures away. `first order`: every patch, by first order, and the strongest ones
#: exactly. `hidden`: blocks of patches, whose keys are cut off. `picture`: blocks of the picture, filled from around.
MapWay = Literal["first order", "hidden", "picture"]
#: Whose queries no longer read it. `all`: nobody reads it. `action`: the action queries alone. `pictures`, `text`: the
#: tokens of pictures, or of the prompt, before the denoise steps.
EffectReaders = Literal["all", "action", "pictures", "text"]
#: What is done to an item. `only`: all but it is cut. `random`: as many other keys are cut. `noise`: another seed.
EffectChange = Literal["nothing", "noise", "without", "only", "random", "prompt", "image"]
#: What an item is. `exchange`: a word for which another stands; of other sentences, what they are to the task's own.
EffectItemKind = (
    Literal["", "word", "exchange", "part", "text", "token", "camera", "pictures", "object", "group"] | PromptKind
)


class OtherPrompt(Document, frozen=True):
    """A row of a prompt table: what a task is told instead. Without a sentence it is `empty`, or `shuffled` by us."""

    task_id: int
    kind: PromptKind
    sentence: str = ""

    def __post_init__(self) -> None:
        """Check that the sentence is there where the kind needs one."""
        if (self.kind == "empty") if self.sentence else (self.kind not in ("empty", "shuffled")):
            raise BadArgument(
                f"A prompt of the kind '{self.kind}' has the sentence '{visible(self.sentence)}'; 'empty' has none, "
                "'shuffled' may have one, every other kind needs one."
            )

    @property
    def change(self) -> PromptChange:
        """The row as a change of the prompt."""
        if self.sentence:
            return PromptChange("text", text=self.sentence, meaning=self.kind)
        return PromptChange("empty" if self.kind == "empty" else "shuffled", meaning=self.kind)


class MapBlocks(Document, frozen=True):
    """The blocks that a map takes away exactly, one at a time: `rows` x `columns` of every camera's picture."""

    way: Literal["hidden", "picture"]
    rows: int
    columns: int

    def __post_init__(self) -> None:
        """Check that there are blocks."""
        if min(self.rows, self.columns) < 1 or self.rows * self.columns < 2:
            raise BadArgument(
                f"A map (--effects) of {self.rows} x {self.columns} blocks of a picture; expected two or more (8x8)."
            )

    def describe(self) -> str:
        """What happens to a block, in words."""
        return "hidden" if self.way == "hidden" else "filled from its surroundings in the picture"


class EffectsRecorded(Document, frozen=True):
    """Which effects a run measures.

    `every`: at every so many replans, from the first on. `denoise_steps`: network evaluations of a changed call.
    `seed`: of the random keys, and of the other noise. `groups`: the selector of each group, by name. `prompts`: the
    prompt table. `blocks`: of the map; None for one by first order. `controls`: whether items are kept alone, and as
    many random keys are cut.
    """

    items: tuple[EffectItems, ...]
    readers: tuple[EffectReaders, ...]
    every: int
    denoise_steps: int
    seed: int
    groups: dict[str, str] = field(default_factory=dict)
    prompts: tuple[OtherPrompt, ...] = ()
    blocks: MapBlocks | None = None
    controls: bool = True

    def __post_init__(self) -> None:
        """Check that something is measured, and the numbers."""
        if not self.items or not self.readers:
            raise BadArgument("Effects without an item or without a reader: nothing would be measured.")
        if self.every < 1 or self.denoise_steps < 1 or self.seed < 0:
            raise BadArgument(
                f"Effects at every {self.every} replans, of {self.denoise_steps} denoise steps, with the seed "
                f"{self.seed}; expected at least 1, 1 and 0."
            )

    @property
    def most_prompts(self) -> int:
        """The most rows that the prompt table has of a task."""
        return max(Counter(row.task_id for row in self.prompts).values(), default=0)


class EffectItem(Document, frozen=True):
    """What a condition takes away or exchanges, and whose queries no longer read it.

    `name`: the word, camera, object or group; of a part of the prompt its role, of a token its site and number; empty
    for all pictures, all text, and the whole sentence. `instead`: the word, sentence or kind of picture that
    stands in its place. `reader`: empty where nothing is cut.
    """

    change: EffectChange
    kind: EffectItemKind = ""
    name: str = ""
    instead: str = ""
    reader: EffectReaders | Literal[""] = ""


class EffectMap(Document, frozen=True):
    """Which patches move the actions of an episode's calls, one patch or block of patches at a time.

    Row i of `effects/map` (row, block) is of replan `replan[i]`: how far the first `steps` actions change without each
    block, root mean square of the normalised actions. By `first order`, from `projections` random directions, it is an
    order of the patches; sizes are those of `effects/patch_change` alone, whose entry i is the exact change without
    block `patch[i]` at replan `patch_replan[i]`, in the units of the episode's effects. Of each replan these are its
    strongest patches by first order, and some of the others that were drawn at random (`drawn[i]`), which say how far
    the order can be trusted. Of the other ways (`MapWay`) they are all blocks that show a part of a picture, and the
    map has their sizes. Where all replans have the same blocks, and none is drawn, `patch` has them once, and
    `patch_replan` and `drawn` are empty.

    keys: of the patches, at the site `site`, cameras in the order of its keys. blocks: the block of each of them; empty
    where each is its own. grid: rows and columns of blocks of a picture, as they were asked for; empty where each patch
    is its own. reader: whose queries do without it, empty where the picture is another one.
    """

    site: str
    keys: tuple[int, ...]
    projections: int
    steps: int
    replan: tuple[int, ...]
    patch_replan: tuple[int, ...]
    patch: tuple[int, ...]
    drawn: tuple[bool, ...]
    way: MapWay = "first order"
    blocks: tuple[int, ...] = ()
    reader: EffectReaders | Literal[""] = "all"
    grid: tuple[int, ...] = ()

    @property
    def entries(self) -> list[tuple[int, int, bool]]:
        """Replan and block of every entry of `effects/patch_change`, and whether it was drawn at random."""
        if not self.patch_replan:
            return [(replan, patch, False) for replan in self.replan for patch in self.patch]
        return list(zip(self.patch_replan, self.patch, self.drawn, strict=True))

    @property
    def made_like(self) -> tuple[object, ...]:
        """What two maps have in common whose sizes can be compared."""
        return self.way, self.blocks, self.reader, self.steps, self.keys

    @property
    def num_blocks(self) -> int:
        """Length of a row of the map."""
        return max(self.blocks, default=-1) + 1 if self.blocks else len(self.keys)

    def __post_init__(self) -> None:
        """Check that entries are of replans and blocks of the map."""
        numbers = {len(self.patch_replan), len(self.drawn)}
        if numbers not in ({0}, {len(self.patch)}) or not set(self.patch_replan) <= set(self.replan):
            raise BadArgument("Exact changes of a map are of other replans than its rows.")
        if self.blocks and (len(self.blocks) != len(self.keys) or set(self.blocks) != set(range(max(self.blocks) + 1))):
            raise BadArgument(f"A map of {len(self.keys)} patches has blocks of others, or without a patch.")
        if any(not 0 <= one < self.num_blocks for one in self.patch):
            raise BadArgument(f"Exact changes of a map are of blocks beyond its {self.num_blocks}.")


class EpisodeEffects(Document, frozen=True):
    """The effects of one episode: what its arrays `effects/change` and `SITE/cut` are of.

    Entry i of these arrays is of replan `replan[i]` under `conditions[condition[i]]`, which is of the item at the same
    place of `items`. A replan without an entry of a condition was not measured under it: the word is not in its prompt,
    the object is out of view, the replan was skipped, or its calls were refused. `units`: how far a change of 1 moves
    the robot, by dimension of the action. `silent_blocks`: modules of a hybrid policy that ran without an attention
    call (linear attention, state spaces): keys were cut off in the others only, whoever the reader is. `map`: None
    where none was made.
    """

    conditions: tuple[Interventions, ...]
    items: tuple[EffectItem, ...]
    units: tuple[Number, ...]
    replan: tuple[int, ...]
    condition: tuple[int, ...]
    silent_blocks: tuple[str, ...] = ()
    map: EffectMap | None = None

    def __post_init__(self) -> None:
        """Check that each condition has its item."""
        if len(self.conditions) != len(self.items):
            raise BadArgument(f"{len(self.conditions)} conditions have {len(self.items)} items; expected one for each.")
