"""What is changed in the policy calls of an episode."""

from __future__ import annotations

from benchmarks.validation.calls import NOISE, NOTHING
from vla_attention.capture.environments.cubes.environment import MARK
from vla_attention.capture.environments.cubes.tasks import NAMED_COLOURS
from vla_attention.schemas.interventions import ImageChange, Interventions, KeyKnockout, PromptChange, Queries
from vla_attention.schemas.stores.reader import StoredEpisode

BASE_CAMERA, WRIST_CAMERA = "base_0_rgb", "left_wrist_0_rgb"
#: Colour -> the one that is named in its place.
NEXT_COLOUR = dict(zip(NAMED_COLOURS, (*NAMED_COLOURS[1:], NAMED_COLOURS[0]), strict=True))
PICTURES, INSTRUCTION = "role:image", "role:instruction"
TEXT = "role:bos | role:template | role:instruction | role:state"


def without(
    selector: str, queries: Queries = "all", *, by: str | None = None, random_seed: int | None = None
) -> Interventions:
    """Tokens that some queries cannot read. by: the queries of `prefix` alone that this selector takes."""
    return Interventions(keys=(KeyKnockout(selector, queries=queries, query_selector=by, random_seed=random_seed),))


def colour_word(episode: StoredEpisode) -> str | None:
    """The first colour that the instruction names."""
    return next((word for word in episode.attributes.instruction.split() if word in NEXT_COLOUR), None)


def other_colour(instruction: str) -> str:
    """The instruction with the next colour in place of each."""
    return " ".join(NEXT_COLOUR.get(word, word) for word in instruction.split())


def known_changes(episode: StoredEpisode) -> dict[str, Interventions]:
    """The changes by the names of `numbers.NUMBERS`, without those that an episode has no word or object for."""
    wrist, colour = f"camera:{WRIST_CAMERA}", colour_word(episode)
    changes = {
        NOTHING: Interventions(),
        "noise": NOISE,
        "instruction": without(INSTRUCTION),
        "instruction_action": without(INSTRUCTION, "action"),
        "instruction_random": without(INSTRUCTION, "action", random_seed=0),
        "prompt_empty": Interventions(prompt=PromptChange("empty")),
        "wrist_action": without(wrist, "action"),
        "wrist_random": without(wrist, "action", random_seed=0),
        "wrist_blank": Interventions(images=(ImageChange(WRIST_CAMERA, "blank"),)),
    }
    if colour is not None:
        word, told = f"word:{colour}", other_colour(episode.attributes.instruction)
        changes |= {
            "colour": without(word),
            "colour_action": without(word, "action"),
            "colour_by_pictures": without(word, "prefix", by=PICTURES),
            "colour_by_text": without(word, "prefix", by=TEXT),
            "colour_random": without(word, random_seed=0),
            "prompt_other_colour": Interventions(prompt=PromptChange("text", text=told)),
        }
    if any(thing.name == MARK for thing in episode.attributes.objects):
        changes |= {
            "mark": without(f"object:{MARK}"),
            "mark_filled": Interventions(images=(ImageChange(BASE_CAMERA, "filled", object=MARK),)),
        }
    return changes
