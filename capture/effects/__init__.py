"""Effects measured beside attention: each policy call made again without a word, a part of the prompt, a picture."""
