"""What the action depends on: how it changes without a word, a picture, an object, beside the attention to these."""

from vla_attention.analyze.commands.effects.answer import effects, word_effects

__all__ = ["effects", "word_effects"]
