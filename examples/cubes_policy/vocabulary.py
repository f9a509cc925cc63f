"""The vocabulary of the small policy: whole words, one token per number, letters, and bytes for everything else.

The model file is an ordinary sentencepiece model. It is made from the lists below alone, so that it is the same
wherever it is made.
"""

from __future__ import annotations

import io

import sentencepiece

#: Numbers of the prompt format `task-state-action`. openpi's formula gives -1 below the first bin.
NUMBERS = range(-1, 256)

#: Pieces of the prompt format, in which no instruction takes part.
_TEMPLATE = ("Task:", "▁State:", "Action:", ",", ";", "\n", ".", "?", "!", "'", "-")

#: Words that are one token each: those of the suite `cubes` first, then common words of instructions for a robot arm.
#: The policy is trained on the first ones only; the others exist so that one can ask it something else.
_WORD_LIST = """
touch lift push put the cube red green blue to left right on yellow of one next in do what mark says
a an and or not no with without from into onto over under above below behind before after between beside near
at by it its this that these those there here all both each every any some other another same different first
second third last two three four five six seven eight nine ten then while until now again only also very as is
are be was black white gray grey orange purple pink brown cyan magenta dark light bright colour color coloured
colored take grab grasp hold pick place drop release move bring carry give pull drag slide turn rotate twist
flip tilt tip open close shut stack unstack insert remove press tap hit knock poke point reach go come stop
wait start begin finish stay stand raise lower up down swap exchange sort gather collect clear clean wipe
sweep cover uncover fill empty pour shake stir throw fold unfold hang align arrange build make set keep leave
find look see show choose select get let help try use avoid ignore follow approach return block blocks cubes
box boxes ball balls bowl bowls plate plates cup cups mug mugs can cans bottle bottles bread milk butter
cheese soup sauce basket baskets tray trays drawer drawers cabinet cabinets door doors shelf shelves stove pan
pot pots pans spoon fork knife lid bin bins table tables floor wall robot arm hand hands gripper finger
fingers object objects thing things item items toy toys book books pen tool handle button switch knob peg nut
ring cylinder sphere tower pile row line middle center centre side sides edge edges corner corners top bottom
front back end inside outside forward backward backwards away toward towards across along around through off
out apart together leftmost rightmost nearest closest farthest furthest far high low higher big bigger biggest
large larger largest small smaller smallest little tall taller short shorter long wide heavy soft hard square
round flat slowly slow quickly fast gently carefully firmly please you your i me my we us can't don't never
always who which where when how why if so but than too more less most least bit once twice north south east
west upward downward upwards downwards sideways halfway
"""
WORDS = tuple(_WORD_LIST.split())

_LETTERS = "abcdefghijklmnopqrstuvwxyzABCDEFGHIJKLMNOPQRSTUVWXYZ0123456789"


def number_piece(number: int) -> str:
    """Return the piece of a number of the prompt; "▁" is sentencepiece's sign for the space before it."""
    return f"▁{number}"


def make_tokenizer() -> bytes:
    """Return the sentencepiece model. A listed word is one token; another is spelt in letters, then in bytes."""
    symbols = [*_TEMPLATE, *(f"▁{word}" for word in dict.fromkeys(WORDS)), *(number_piece(n) for n in NUMBERS)]
    controls, num_bytes, space = 4, 256, 1
    model = io.BytesIO()
    sentencepiece.SentencePieceTrainer.train(
        sentence_iterator=iter([f"{_LETTERS} "] * 2),
        model_writer=model,
        model_type="bpe",
        vocab_size=controls + num_bytes + space + len(_LETTERS) + len(symbols),
        hard_vocab_limit=False,
        character_coverage=1.0,
        pad_id=0,
        eos_id=1,
        bos_id=2,
        unk_id=3,
        byte_fallback=True,
        user_defined_symbols=symbols,
        normalization_rule_name="identity",
        add_dummy_prefix=False,
        remove_extra_whitespaces=False,
        num_threads=1,
        minloglevel=2,
    )
    return model.getvalue()
