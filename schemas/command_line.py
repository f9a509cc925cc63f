"""What both command lines share: parsers, byte counts, and mistakes that end with one sentence and exit code 2."""

from __future__ import annotations

import argparse
import os
import re
import sys
import textwrap
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

from vla_attention.schemas.errors import Note, UserError, did_you_mean, shortened
from vla_attention.schemas.safe_text import visible, visible_output
from vla_attention.schemas.stop_signals import run_until_stopped

if TYPE_CHECKING:
    from _typeshed import SupportsWrite

#: Columns of a help text.
_HELP_WIDTH = 100


#: What `--help` shows of a command with more options than these; `--help-all` shows all.
_MOST_OPTIONS = 6
_MOST_EXAMPLES = 3
_MAIN_OPTIONS = {
    *("--checkpoint", "--ckpt-path", "--task-suite", "--task", "--num-episodes", "--effects", "--knockout", "--series"),
    *("--policy", "--layers", "--grouping", "--group", "--ratio", "--episode", "--open", "--video"),
    *("--csv", "--output", "--resume", "--repair", "--tar"),
    *("--without", "--file", "--port", "--help-all"),
}


class _HelpAll(argparse.Action):
    """Prints the help with every option."""

    def __call__(self, parser: Any, namespace: Any, values: Any, option_string: str | None = None) -> None:
        parser.shows_all = True
        parser.print_help()
        parser.exit()


class _WideHelp(argparse.RawDescriptionHelpFormatter):
    def __init__(self, prog: str) -> None:
        super().__init__(prog, max_help_position=26, width=_HELP_WIDTH)


#: What argparse says of a value that is none of its choices.
_CHOICE = re.compile(r"invalid choice: '(.*)' \(choose from (.*)\)")


class OneSentenceParser(argparse.ArgumentParser):
    """An argument parser whose mistakes read like all the others, and whose help fits a screen.

    Its help shows the description wrapped, and below the arguments the epilog as it is.
    """

    shows_all = False
    #: The beginning of an option that other programs have -> what to type here.
    instead: Mapping[str, str] = {}

    def __init__(self, *, description: str = "", **options: Any) -> None:
        as_is = argparse.RawDescriptionHelpFormatter
        super().__init__(description=textwrap.fill(description, _HELP_WIDTH), formatter_class=as_is, **options)
        if self.add_help:
            self.add_argument("--help-all", action=_HelpAll, nargs=0, default=argparse.SUPPRESS, help="every option")

    def format_help(self) -> str:
        """The help: the main options, where there are many."""
        options = [one for one in self._actions if one.option_strings and one.help != argparse.SUPPRESS]
        rest = [one for one in options if not {*one.option_strings} & _MAIN_OPTIONS]
        if self.shows_all or len(options) <= _MOST_OPTIONS:
            return super().format_help()
        kept, usage, epilog, formatter = [one.help for one in rest], self.usage, self.epilog, self.formatter_class
        places = " ".join(
            f"{one.metavar or one.dest}{' ...' if one.nargs == '+' else ''}"
            for one in self._actions
            if not one.option_strings
        )
        try:
            for one in rest:
                one.help = argparse.SUPPRESS
            self.usage = usage or f"%(prog)s {places} [options]".replace("  ", " ")
            self.epilog, self.formatter_class = _first_examples(epilog), _WideHelp
            return super().format_help()
        finally:
            self.usage, self.epilog, self.formatter_class = usage, epilog, formatter
            for one, text in zip(rest, kept, strict=True):
                one.help = text

    def parse_args(self, args: Sequence[str] | None = None, namespace: Any = None) -> Any:  # type: ignore[override]
        """Parse; a word that nothing takes ends with what to type instead, where that is known."""
        given = sys.argv[1:] if args is None else list(args)
        parsed, unknown = self.parse_known_args(given, namespace)
        if unknown:
            self._refuse(unknown[0].split("=")[0], given)
        return parsed

    def _refuse(self, word: str, given: Sequence[str]) -> NoReturn:
        """End with a word that nothing takes."""
        if not word.startswith("-"):
            self.error(f"'{visible(word)}' is more than is expected")
        said = [text for typed, text in self.instead.items() if word == typed or word.startswith(f"{typed}-")]
        known = list(self._option_string_actions)
        for action in self._actions:
            if isinstance(action, argparse._SubParsersAction):
                known += [option for name in given for option in _options_of(action.choices.get(name))]
        near = f" {said[0]}" if said else did_you_mean(word, known)
        self.exit(2, f"{self.prog}: There is no option '{visible(word)}'.{near} See {self.prog} --help.\n")

    def error(self, message: str) -> NoReturn:
        """Print the problem and where help is; exit code 2."""
        wrong = _CHOICE.search(message)
        near = did_you_mean(wrong[1], re.findall(r"[\w-]+", wrong[2])) if wrong else ""
        self.exit(2, f"{self.prog}: {message}.{near} See {self.prog} --help.\n")

    def _print_message(self, message: str, file: SupportsWrite[str] | None = None) -> None:
        """Print a help text or a mistake; a help text that cannot be written is an `OSError`, which argparse hides."""
        is_help = file is sys.stdout
        if is_help:
            sys.stdout.write(message)
            sys.stdout.flush()
        else:
            super()._print_message(message, file)


def _options_of(parser: argparse.ArgumentParser | None) -> list[str]:
    return [] if parser is None else list(parser._option_string_actions)


def _first_examples(epilog: str | None) -> str | None:
    """The first examples of a text below the arguments; --help-all has it whole."""
    lines = (epilog or "").splitlines()
    if "examples:" not in lines:
        return epilog
    first = lines.index("examples:")
    last, count = first + 1, 0
    while last < len(lines) and lines[last].startswith(" "):
        count += not lines[last - 1].endswith("\\")
        if count > _MOST_EXAMPLES:
            break
        last += 1
    return "\n".join(lines[first:last])


def format_bytes(count: float) -> str:
    """A byte count with 3 significant digits and a decimal unit: 1.23 GB."""
    for unit in ("B", "kB", "MB", "GB"):
        if count < 999.5:
            return f"{count:.3g} {unit}"
        count /= 1000
    return f"{count:.3g} TB"


def run_command(program: str, command: Callable[[], int], if_stopped: str) -> int:
    """Run a command and return its exit code; see `run_until_stopped` for signals.

    A `UserError` becomes one sentence and 2, and so does what the operating system refuses: a full disk, a missing
    permission, no memory. Control characters in what the command prints are made visible
    (`safe_text.visible_output`), and a `Note` is a line on stderr.
    """
    with visible_output(), _notes_as_lines(program):
        return run_until_stopped(program, lambda: _run(program, command), if_stopped)


def _run(program: str, command: Callable[[], int]) -> int:
    try:
        code = command()
        sys.stdout.flush()  # what is left of the text may not fit on the disk
        return code
    except UserError as error:
        # One line, whatever a name in it holds: a line of its own could pass for another message.
        sentence = str(error)
    except BrokenPipeError:  # `| head` has seen enough
        _drop_output()
        return 141
    except OSError as error:
        sentence = visible(describe_os_error(error))
    except MemoryError:
        sentence = "The memory is full. Close other programs, or use a machine with more memory."
    with suppress(OSError):
        print(f"{program}: {sentence}", file=sys.stderr, flush=True)
    try:
        sys.stdout.flush()
    except OSError:
        _drop_output()
    return 2


def describe_os_error(error: OSError) -> str:
    """What the operating system refused, in one sentence."""
    from vla_attention.schemas.stores.store_place import why_refused

    named = [str(name) for name in (error.filename, error.filename2) if name is not None]
    where = f" {' -> '.join(map(shortened, named))}" if named else ""
    why = why_refused(error, Path(named[-1])) if named else error.strerror or str(error) or type(error).__name__
    return f"The operating system refused{where or ' to go on'}: {why}."


def _drop_output() -> None:
    """Send the rest of stdout nowhere, or the interpreter complains when it flushes at its end."""
    with suppress(OSError, ValueError):
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


@contextmanager
def _notes_as_lines(program: str) -> Iterator[None]:
    """Print each `Note` once, as a line of the program, instead of as Python's warnings with file and line."""
    said: set[str] = set()
    before = warnings.showwarning

    def show(message: Warning | str, category: type[Warning], *where: Any, **more: Any) -> None:
        if not issubclass(category, Note):
            before(message, category, *where, **more)
        elif str(message) not in said:
            said.add(str(message))
            print(f"{program}: {visible(str(message))}", file=sys.stderr)

    with warnings.catch_warnings():
        warnings.simplefilter("always", Note)
        warnings.showwarning = show
        yield
