"""What is changed in the policy calls of an episode, for the policies whose dependence is known and for mixing."""

from __future__ import annotations

from benchmarks.validation.calls import NOISE
from vla_attention.capture.environments.cubes.environment import MARK
from vla_attention.capture.environments.cubes.tasks import NAMED_COLOURS
from vla_attention.schemas.interventions import (
    ImageChange,
    Interventions,
    KeyKnockout,
    PromptChange,
    Queries,
)
from vla_attention.schemas.stores.reader import StoredEpisode

BASE_CAMERA, WRIST_CAMERA = "base_0_rgb", "left_wrist_0_rgb"
COLOUR_WORDS = NAMED_COLOURS
#: Colour -> the one that is named in its place.
NEXT_COLOUR = dict(zip(COLOUR_WORDS, (*COLOUR_WORDS[1:], COLOUR_WORDS[0]), strict=True))
VISUAL, INSTRUCTION = "role:image", "role:instruction"
#: The linguistic side of the default grouping, and all keys of the prompt, which could all carry the instruction on.
LINGUISTIC = "role:bos | role:template | role:instruction"
TEXT = f"{LINGUISTIC} | role:state"


def without(
    selector: str, queries: Queries = "action", *, keep: bool = False, random_seed: int | None = None
) -> Interventions:
    """A group of keys knocked out; arguments as in `KeyKnockout`."""
    return Interventions(keys=(KeyKnockout(selector, keep=keep, queries=queries, random_seed=random_seed),))


def colour_word(episode: StoredEpisode) -> str | None:
    """The first colour that the instruction names."""
    return next((word for word in episode.attributes.instruction.split() if word in COLOUR_WORDS), None)


def other_colour(instruction: str) -> str:
    """The instruction with the next colour in place of each."""
    return " ".join(NEXT_COLOUR.get(word, word) for word in instruction.split())


def named_object(episode: StoredEpisode) -> str | None:
    """The cube that the task is about; stores of the suite with a constant sentence know it too."""
    names = [thing.name for thing in episode.attributes.objects if thing.of_interest and thing.name != MARK]
    return names[0] if len(names) == 1 else None


def known_changes(episode: StoredEpisode) -> dict[str, Interventions]:
    """The changes of question 1; those that an episode has no word or object for are left out."""
    changes = {
        "nothing": Interventions(),
        "noise": NOISE,
        "without_visual": without(VISUAL),
        "only_visual": without(VISUAL, keep=True),
        "without_linguistic": without(LINGUISTIC),
        "only_linguistic": without(LINGUISTIC, keep=True),
        "without_instruction": without(INSTRUCTION),
        "without_instruction_all": without(INSTRUCTION, "all"),
        "random_instruction": without(INSTRUCTION, random_seed=0),
        "prompt_empty": Interventions(prompt=PromptChange("empty")),
        "without_wrist": without(f"camera:{WRIST_CAMERA}"),
        "without_wrist_all": without(f"camera:{WRIST_CAMERA}", "all"),
        "random_wrist": without(f"camera:{WRIST_CAMERA}", random_seed=0),
        "wrist_blank": Interventions(images=(ImageChange(WRIST_CAMERA, "blank"),)),
        "without_base": without(f"camera:{BASE_CAMERA}"),
        "base_blank": Interventions(images=(ImageChange(BASE_CAMERA, "blank"),)),
    }
    words = episode.attributes.instruction.split()
    colour, named = colour_word(episode), named_object(episode)
    if colour is not None:
        changes |= {
            "without_colour": without(f"word:{colour}"),
            "without_colour_all": without(f"word:{colour}", "all"),
            "random_colour": without(f"word:{colour}", random_seed=0),
            "without_verb": without(f"word:{words[0]}"),
            "prompt_other_colour": Interventions(
                prompt=PromptChange("text", text=other_colour(episode.attributes.instruction))
            ),
        }
    if named is not None:
        changes["without_named"] = without(f'object:"{named}"')
    if any(thing.name == MARK for thing in episode.attributes.objects):
        changes |= {
            "without_mark": without(f"object:{MARK}"),
            "without_mark_all": without(f"object:{MARK}", "all"),
            "mark_filled": Interventions(images=(ImageChange(BASE_CAMERA, "filled", object=MARK),)),
        }
    return changes


def mixing_changes(episode: StoredEpisode) -> dict[str, Interventions]:
    """The changes of question 3: knockouts for the action queries, beside cuts between text and pictures in the prefix.

    Names end with what is cut in the prefix: `blind` is text that cannot read pictures, `deaf` pictures that cannot
    read text, `apart` both. The last of them take the words from one kind of queries each.
    """
    blind = KeyKnockout(VISUAL, queries="prefix", query_selector=TEXT)
    deaf = KeyKnockout(TEXT, queries="prefix", query_selector=VISUAL)
    cuts = {"whole": (), "blind": (blind,), "deaf": (deaf,), "apart": (blind, deaf)}
    groups = {"nothing": None, "instruction": INSTRUCTION, "text": TEXT, "visual": VISUAL}
    colour = colour_word(episode)
    if colour is not None:
        groups["colour"] = f"word:{colour}"
    changes = {}
    for cut, keys in cuts.items():
        for group, selector in groups.items():
            own = () if selector is None else (KeyKnockout(selector),)
            changes[f"{group}_{cut}"] = Interventions(keys=(*keys, *own))
    for name, selector in (("instruction", INSTRUCTION), ("colour", groups.get("colour"))):
        if selector is not None:
            for reader, knockout in readers_of(selector).items():
                changes[f"{name}_{reader}"] = Interventions(keys=(knockout,))
    return changes


def readers_of(selector: str) -> dict[str, KeyKnockout]:
    """Reader -> the knockout of a group of keys for these queries alone; the last is the control of the one before.

    In the prefix the queries of pictures or of text read the group, and carry it on to the action queries.
    """
    return {
        "by_pictures": KeyKnockout(selector, queries="prefix", query_selector=VISUAL),
        "by_text": KeyKnockout(selector, queries="prefix", query_selector=TEXT),
        "everywhere": KeyKnockout(selector, queries="all"),
        "random": KeyKnockout(selector, queries="all", random_seed=0),
    }
