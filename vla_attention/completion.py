"""`vla-attention completion bash|zsh`: commands, options and their values for the completion of a shell.

The script is made from the parsers of the installed version, and holds plain lists: pressing TAB starts no Python, as
with argcomplete it would. shtab writes such scripts too, but knows no command that may be left out, as it may be in
`vla-analyze STORE --layers`.
"""

from __future__ import annotations

import argparse
import shlex
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from vla_attention.schemas.command_line import command_parser, run_command

PROGRAM = "vla-attention completion"
_EXAMPLES = """examples:
  vla-attention completion bash > ~/.vla-attention-completion.sh
  echo '. ~/.vla-attention-completion.sh' >> ~/.bashrc     for zsh: completion zsh, and ~/.zshrc
  eval "$(vla-attention completion bash)"                  in this shell alone

Make the file again after an upgrade; it completes vla-attention, vla-analyze and vla-capture.
"""
#: The functions of the script; %s: the lists. bash 3.2, which macOS has, knows neither associative arrays nor mapfile.
_SCRIPT = r"""# Completion of vla-attention, vla-analyze and vla-capture; made by `vla-attention completion`.
if [ -n "${ZSH_VERSION-}" ]; then
  type compdef >/dev/null 2>&1 || { autoload -Uz compinit && compinit; }
  autoload -Uz bashcompinit && bashcompinit
fi

_vla_attention_commands() {
  case "$1" in
%(commands)s
  esac
}

_vla_attention_options() {
  case "$1" in
%(options)s
  esac
}

_vla_attention_values() {
  case "$1" in
%(values)s
  esac
}

# Where a function leaves COMPREPLY empty, the shell completes names of files.
_vla_attention_complete() {
  local word="${COMP_WORDS[COMP_CWORD]}" before="${COMP_WORDS[COMP_CWORD-1]}" program="${COMP_WORDS[0]##*/}"
  local found="" i=1 next
  while [ "$i" -lt "$COMP_CWORD" ]; do
    next="${COMP_WORDS[i]}"
    case " $(_vla_attention_commands "$program") " in
      *" $next "*) program="$program $next"; i=$((i + 1)) ;;
      *) break ;;
    esac
  done
  case "$before" in
    -*) found="$(_vla_attention_values "$program $before")" ;;
  esac
  if [ -z "$found" ]; then
    case "$word" in
      -*) found="$(_vla_attention_options "$program")" ;;
      *) if [ "$i" -eq "$COMP_CWORD" ]; then found="$(_vla_attention_commands "$program")"; fi ;;
    esac
  fi
  COMPREPLY=($(compgen -W "$found" -- "$word"))
}

complete -o bashdefault -o default -F _vla_attention_complete vla-attention vla-analyze vla-capture
"""


@dataclass(frozen=True)
class Command:
    """What may follow some words on the command line.

    Attributes:
        words: the program and its commands so far, as in "vla-analyze words".
        commands: the commands, or values of a first argument, that may come next.
        options: every option.
        values: option -> its values, where there is a list of them.
    """

    words: str
    commands: tuple[str, ...]
    options: tuple[str, ...]
    values: dict[str, tuple[str, ...]]


def main(argv: Sequence[str]) -> int:
    """Print the script of a shell; returns the exit code."""
    parser = command_parser(PROGRAM, "Print a script with which a shell completes commands and options.", _EXAMPLES)
    parser.add_argument("shell", choices=("bash", "zsh"), help="the shell; both read the same script")
    parser.parse_args(argv)

    def run() -> int:
        sys.stdout.write(completion_script())
        return 0

    return run_command(PROGRAM, run, "nothing was written.")


def completion_script() -> str:
    """The script, for bash from 3.2 on and for zsh."""
    known = list(commands_of_all_programs())
    return _SCRIPT % {
        "commands": _cases((command.words, command.commands) for command in known),
        "options": _cases((command.words, command.options) for command in known),
        "values": _cases(
            (f"{command.words} {option}", values) for command in known for option, values in command.values.items()
        ),
    }


def commands_of_all_programs() -> Iterator[Command]:
    """Every command of the three programs, from their parsers."""
    from vla_attention.__main__ import COMMANDS

    analyses = list(_analyze_commands())
    names = [command.words.removeprefix("vla-analyze").strip() for command in analyses]
    yield Command("vla-attention", (*COMMANDS, *filter(None, names)), ("--help", "--version"), {})
    yield Command("vla-attention example", (), ("--help",), {})
    yield Command("vla-attention completion", ("bash", "zsh"), ("--help",), {})
    for command, name in zip(analyses, names, strict=True):
        yield command
        for words in dict.fromkeys((f"vla-attention analyze {name}".strip(), f"vla-attention {name or 'analyze'}")):
            yield Command(words, command.commands, command.options, command.values)
    for command in _capture_commands():
        yield command
        rest = command.words.removeprefix("vla-capture")
        yield Command(f"vla-attention capture{rest}", command.commands, command.options, command.values)


def _analyze_commands() -> Iterator[Command]:
    from vla_attention.analyze.command_line import build_parser
    from vla_attention.analyze.registry import COMMANDS

    without = _command("vla-analyze", build_parser(""))
    yield Command(without.words, tuple(COMMANDS), without.options, without.values)
    for name in COMMANDS:
        yield _command(f"vla-analyze {name}", build_parser(name))


def _capture_commands() -> Iterator[Command]:
    from vla_attention.capture.commands.arguments import build_parser

    names = _subparsers(build_parser())
    yield Command("vla-capture", tuple(names), ("--help",), {})
    for name in names:
        # Some commands have more options once they are named.
        yield _command(f"vla-capture {name}", _subparsers(build_parser([name]))[name])


def _subparsers(parser: argparse.ArgumentParser) -> dict[str, argparse.ArgumentParser]:
    (commands,) = (action for action in parser._actions if isinstance(action, argparse._SubParsersAction))
    return dict(commands.choices)


def _command(words: str, parser: argparse.ArgumentParser) -> Command:
    """What the parser of a command without commands of its own knows."""
    options: list[str] = []
    values: dict[str, tuple[str, ...]] = {}
    first: tuple[str, ...] = ()
    for action in parser._actions:
        if action.help == argparse.SUPPRESS:
            continue
        options += action.option_strings
        choices = tuple(str(choice) for choice in action.choices or ())
        if not action.option_strings:
            first = first or choices
        values |= dict.fromkeys(action.option_strings, choices) if choices else {}
    return Command(words, first, tuple(options), values)


def _cases(lists: Iterator[tuple[str, tuple[str, ...]]]) -> str:
    """Branches of a `case`, of the lists that hold something."""
    return "\n".join(
        f"    {shlex.quote(words)}) echo {shlex.quote(' '.join(held))} ;;" for words, held in lists if held
    )
