"""Texts of grouping files, names and sentences, right and wrong ones, and what Python makes of a file, as JSON."""
# ruff: noqa: RUF001 - letters that look like others are meant

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from vla_attention.schemas.errors import UserError
from vla_attention.schemas.groupings.grouping import read_grouping_file

FILES = (
    '[groups]\nbase = "camera:base_0_rgb"\nrest = "*"\n',
    'name = "mine"\ndescription = "a \\"quoted\\" text, C:\\\\x, \\u00e9, \\u202e"\nallow_empty = ["b"]\n'
    '[groups]\na = ["word:bowl", \'word:"black bowl"\']\nb = "role:image"\n"c.d" = \'\'\'word:"it\'s"\'\'\'\n'
    '[ratio]\nnumerator = ["a", "b"]\ndenominator = ["c.d"]\n',
    'overlap = true\n[groups]\nvisual = "role:image"\nlinguistic = """role:text"""\n',
    'groups = {a = "*"}\n',
    'ratio.numerator = ["a"]\nratio.denominator = ["b"]\ngroups.a = "role:image"\ngroups.b = "*"\n',
    'name = ""\n[groups]\na = "*"\n',
    # Not what is declared.
    "",
    'name = "x"\n',
    "groups = 3\n",
    "[groups]\n",
    "[groups]\na = 3\n",
    "[groups]\na = 3.0\n",
    "[groups]\na = true\n",
    "[groups]\na = 1979-05-27\n",
    "[groups]\na = 07:32:00\n",
    "[groups]\na = 1979-05-27T07:32:00Z\n",
    "[groups]\na = []\n",
    '[groups]\na = ["role:image", 4]\n',
    "[groups]\na = [[]]\n",
    '[groups.a]\nb = "*"\n',
    '[groups]\na = "*"\n[ratio]\nnumerator = "a"\ndenominator = ["a"]\n',
    '[groups]\na = "*"\n[ratio]\nnumerator = ["a"]\n',
    '[groups]\na = "*"\n[ratio]\nnumerator = ["a"]\ndenominator = []\n',
    '[groups]\na = "*"\n[ratio]\nnumerator = ["a"]\ndenominators = ["a"]\n',
    '[groups]\na = "*"\n[ratio]\nnumerator = ["visul"]\ndenominator = ["a"]\n',
    'overlap = 1\n[groups]\na = "*"\n',
    'allow_empty = "a"\n[groups]\na = "*"\n',
    'allow_empty = ["b"]\n[groups]\na = "*"\n',
    'nmae = "x"\n[groups]\na = "*"\n',
    'name = 3\n[groups]\na = "*"\n',
    'name = "a\\u001bb"\n[groups]\na = "*"\n',
    f'name = "{"n" * 5000}"\n[groups]\na = "*"\n',
    '[groups]\n"a b" = "*"\n',
    f"[groups]\n{'n' * 400} = 3\n",
    '[groups]\nratio = "*"\n',
    '[groups]\na = "*"\nb = "*"\n',
    '[groups]\na = ["*", "role:image"]\n',
    '[groups]\na = "rol:image"\n',
    '[groups]\na = "role:image |"\n',
    "[groups]\n" + "".join(f'g{i} = "keys:{i}"\n' for i in range(1001)),
    # No TOML.
    "[groups\n",
    "[groups]\na = \n",
    '[groups]\na = "*"\na = "*"\n',
    "a = 'b\n",
)


def file_answer(folder: Path, text: str) -> dict[str, Any]:
    """The grouping of a file, or the sentence with which it is refused."""
    path = folder / "a b" / "x.toml"
    path.parent.mkdir(exist_ok=True)
    path.write_bytes(text.encode())
    try:
        grouping = read_grouping_file(path)
    except UserError as error:
        return {"error": str(error).replace(str(path), "a b/x.toml")}
    ratio = grouping.ratio
    return {
        "name": grouping.name,
        "description": grouping.description,
        "groups": [[name, list(selectors)] for name, selectors in grouping.groups.items()],
        "ratio": ratio and {"numerator": list(ratio.numerator), "denominator": list(ratio.denominator)},
        "overlap": grouping.overlap,
        "allow_empty": list(grouping.allow_empty),
    }


def made_up_texts(count: int, seed: int = 3) -> tuple[list[tuple[str, list[str]]], list[str]]:
    """Words with the names among which the nearest is looked for, and texts of all kinds of characters."""
    generator = np.random.default_rng(seed)
    letters = list("abcdeßİıΣςſǅᎠꭰẞ_ -'’1²٣½µ🤖\n\x1b\u202e\u00a0é")
    near, texts = [], []
    for number in range(count):
        few = letters[:6] if number % 2 else letters
        lengths = generator.integers(0, 14, 7) if number % 20 else generator.integers(150, 300, 7)
        words = ["".join(generator.choice(few, length)) for length in lengths]
        spelt = words[1][:-2] + words[0][:2]
        near.append((spelt if number % 3 else words[0], words[1:]))
        texts.append(" ".join(words[: int(generator.integers(1, 5))]))
    return near, texts
