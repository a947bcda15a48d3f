"""Options of the ``histmv`` commands: draccus's parsing, with errors that name the option and what is accepted."""

import argparse
import difflib
import io
import re
from collections.abc import Sequence
from typing import Any

from draccus.argparsing import ArgumentParser
from draccus.utils import DecodingError, DraccusException

UNRECOGNIZED = "unrecognized arguments:"


class UsageError(ValueError):
    """The command line has an option that does not exist, or one without its value."""


def parse(config_class: type, args: Sequence[str], prog: str) -> Any:
    """The configuration that a command line describes.

    Raises:
        UsageError: an option does not exist or has no value.
        DraccusException, ValueError: a value is refused; ``reason`` finds the sentence for the user.
    """
    parser = ArgumentParser[Any](config_class, prog=prog, exit_on_error=False)
    try:
        return parser.parse_args(args)
    except argparse.ArgumentError as error:
        raise UsageError(str(error)) from error
    except DraccusException as error:
        if not str(error).startswith(UNRECOGNIZED):
            raise
        known = _options(parser)
        unknown = str(error).removeprefix(UNRECOGNIZED).split()
        raise UsageError("; ".join(_correction(word.partition("=")[0], known) for word in unknown)) from error


def _options(parser: ArgumentParser[Any]) -> list[str]:
    text = io.StringIO()
    parser.parser.print_help(text)
    return sorted(set(re.findall(r"--[a-z][\w.]*", text.getvalue())))


def _correction(word: str, known: Sequence[str]) -> str:
    """What is wrong with a word, and which options exist beside it."""
    group = word.rpartition(".")[0]
    siblings = [option for option in known if option.rpartition(".")[0] == group] or known
    close = difflib.get_close_matches(word, siblings, n=1)
    hint = f", did you mean {close[0]}?" if close else ""
    return f"{word} is not an option{hint} (there are {', '.join(siblings)})"


def underscored(word: str) -> str:
    """``--an-option=value`` as ``--an_option=value``, which is how LeRobot and draccus spell options."""
    option, equals, value = word.partition("=")
    return f"--{option[2:].replace('-', '_')}{equals}{value}" if option.startswith("--") else word


def reason(error: BaseException) -> BaseException:
    """What the user should read: of a value of the wrong kind its option, of refused values why they were refused."""
    while isinstance(error, DraccusException) and not isinstance(error, DecodingError) and error.__cause__ is not None:
        error = error.__cause__
    return error
