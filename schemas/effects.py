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


class EffectsRecorded(Document, frozen=True):
    """Which effects a run measures.

    `every`: at every so many replans, from the first on. `denoise_steps`: network evaluations of a changed call.
    `seed`: of the random keys, and of the other noise. `groups`: the selector of each group, by name. `prompts`: the
    prompt table.
    """

    items: tuple[EffectItems, ...]
    readers: tuple[EffectReaders, ...]
    every: int
    denoise_steps: int
    seed: int
    groups: dict[str, str] = field(default_factory=dict)
    prompts: tuple[OtherPrompt, ...] = ()

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
    """Which patches move the actions of an episode's calls, all queries without a patch at a time.

    Row i of `effects/map` (row, patch) is of replan `replan[i]`: by first order, from `projections` random directions,
    how far the first `steps` actions change without each patch, root mean square of the normalised actions. It is an
    order; sizes are those of `effects/patch_change`, whose entry i is the exact change without patch `patch[i]` at
    replan `patch_replan[i]`, in the units of the episode's effects. Of each replan these are its strongest patches by
    first order, and some of the others that were drawn at random (`drawn[i]`), which say how far the order can be
    trusted.

    keys: of the patches, at the site `site`, cameras in the order of its keys.
    """

    site: str
    keys: tuple[int, ...]
    projections: int
    steps: int
    replan: tuple[int, ...]
    patch_replan: tuple[int, ...]
    patch: tuple[int, ...]
    drawn: tuple[bool, ...]

    def __post_init__(self) -> None:
        """Check that entries are of replans and patches of the map."""
        if not len(self.patch) == len(self.patch_replan) == len(self.drawn) or not set(self.patch_replan) <= set(
            self.replan
        ):
            raise BadArgument("Exact changes of a map are of other replans than its rows.")
        if any(not 0 <= one < len(self.keys) for one in self.patch):
            raise BadArgument(f"Exact changes of a map are of patches beyond its {len(self.keys)}.")


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
