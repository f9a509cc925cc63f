"""docs/my-policy.md, from `inspect` to a verified store, on a policy that no layout knows."""

import doctest
import re
from itertools import count
from pathlib import Path

from examples.small_policy import given

GUIDE = Path(__file__).parents[3] / "docs" / "my-policy.md"


class EqualBesidesRounding(doctest.OutputChecker):
    """Takes P·V errors of some 1e-7 for equal, and sizes: they depend on the processor, which rounds in its own way."""

    def check_output(self, want: str, got: str, optionflags: int) -> bool:
        want, got = (re.sub(r"\b\de-07\b", "1e-07", text) for text in (want, got))
        want, got = (re.sub(r"\b[\d.]+ kB", "some kB", text) for text in (want, got))
        return super().check_output(want, got, optionflags)


def test_the_guides_examples(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    numbers = count()
    names = {"observe": lambda batch=1: given(batch, seed=next(numbers))}
    examples = doctest.DocTestParser().get_doctest(GUIDE.read_text(encoding="utf-8"), names, GUIDE.name, str(GUIDE), 0)
    runner = doctest.DocTestRunner(EqualBesidesRounding(), optionflags=doctest.NORMALIZE_WHITESPACE | doctest.ELLIPSIS)
    result = runner.run(examples)
    assert result.failed == 0
    assert result.attempted > 12
