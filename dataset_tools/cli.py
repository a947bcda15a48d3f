"""The ``histmv`` command: one subcommand per tool, each in a module of its own with a config and ``run(config)``.

A subcommand's module is imported only when it is called, so that ``histmv --help`` is instant.
"""

import difflib
import importlib
import os
import sys
import typing
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, NoReturn

import lerobot_histmv

TRACEBACK_VARIABLE = "HISTMV_TRACEBACK"


@dataclass(frozen=True)
class Command:
    """A subcommand: the module whose ``run`` does it, and the one line that teaches it."""

    module: str
    summary: str


COMMANDS = {
    "view": Command("dataset_tools.view", "watch the scripted expert of a task, in a window or as a video"),
    "record": Command(
        "dataset_tools.record", "let the scripted experts demonstrate a task and write a LeRobot dataset"
    ),
    "convert": Command(
        "dataset_tools.convert.command", "episodes of RLBench's or robomimic's format as a LeRobot dataset"
    ),
    "calibrate-attach": Command(
        "dataset_tools.calibrate.command", "add camera calibrations from a YAML file to a LeRobot dataset"
    ),
    "doctor": Command(
        "dataset_tools.doctor.command", "what is wrong with a LeRobot dataset, and how to mend it, before training"
    ),
    "keyframe": Command("dataset_tools.keyframe", "keep an episode's key poses: a dataset of one row per macro step"),
    "keyframe-many": Command(
        "dataset_tools.many.command", "the same for a large dataset, in pieces, here or on a Slurm cluster"
    ),
    "cache-clip": Command(
        "dataset_tools.clip.command", "store frozen CLIP vectors with a dataset, so that training never runs CLIP"
    ),
    "replay": Command("dataset_tools.replay_check", "do a keyframed dataset's key poses still do the task?"),
    "push": Command("dataset_tools.hub.push", "upload a dataset or a checkpoint to the Hugging Face Hub, with a card"),
    "inspect": Command(
        "dataset_tools.inspect.command", "draw episodes: path, keyframes, errors, tool in every view, cloud"
    ),
    "eval": Command("dataset_tools.evaluate", "success of a checkpoint over unseen scenes, with intervals and videos"),
    "explain": Command(
        "dataset_tools.explain.command",
        "why a checkpoint acted as it did: heat maps, view weights, attention over steps",
    ),
    "demo": Command("dataset_tools.demo", "record, keyframe, train and evaluate on one task, and show the result"),
    "report": Command("dataset_tools.demo_report", "the one-page report of a demo directory, written again"),
    "configs": Command(
        "dataset_tools.config_files", "the YAML files for lerobot-train's --config_path, and where they lie"
    ),
}


def usage() -> str:
    """What ``histmv --help`` prints."""
    width = max(map(len, COMMANDS))
    lines = [f"  {name:<{width}}  {command.summary}" for name, command in COMMANDS.items()]
    return "\n".join(
        [
            "usage: histmv COMMAND [--option=value ...]",
            "",
            "HistMV for LeRobot: from recorded episodes to a keyframe policy.",
            "",
            "commands, in the order in which one needs them:",
            *lines,
            "",
            "histmv COMMAND --help lists a command's options. Training is LeRobot's own:",
            "  lerobot-train --config_path=$(histmv configs --name=train/default) --dataset.root=...",
        ]
    )


def runner(name: str) -> tuple[Callable[[Any], None], type]:
    """The ``run`` function of subcommand ``name`` and the config dataclass that it takes."""
    run = importlib.import_module(COMMANDS[name].module).run
    hints = typing.get_type_hints(run)
    hints.pop("return", None)
    (config_class,) = hints.values()
    return run, config_class


def dispatch(name: str, arguments: Sequence[str]) -> None:
    """Parse ``arguments`` as subcommand ``name``'s config and run it.

    A config class with a ``parse`` of its own reads what draccus alone cannot, such as LeRobot's ``--policy.path``.
    """
    from dataset_tools import command_line

    run, config_class = runner(name)
    parse = getattr(config_class, "parse", partial(command_line.parse, config_class))
    run(parse(args=[command_line.underscored(word) for word in arguments], prog=f"histmv {name}"))


def user_errors() -> tuple[type[Exception], ...]:
    """Exceptions whose message is written for the user: no traceback is shown for them."""
    from draccus.utils import DraccusException

    return (ValueError, OSError, DraccusException)


def fail(name: str, error: Exception) -> NoReturn:
    """Say what was wrong in a sentence and exit."""
    from dataset_tools.command_line import UsageError, reason

    if isinstance(error, UsageError):
        print(f"histmv {name}: {error}\n(histmv {name} --help explains the options)", file=sys.stderr)
        sys.exit(2)
    print(f"histmv {name}: {reason(error)}\n({TRACEBACK_VARIABLE}=1 shows where this was raised)", file=sys.stderr)
    sys.exit(1)


def main(argv: Sequence[str] | None = None) -> None:
    """Entry point of ``histmv``; exits with 2 for a wrong command line and 1 for a failed run."""
    arguments = list(sys.argv[1:] if argv is None else argv)
    if not arguments or arguments[0] in ("-h", "--help", "help"):
        print(usage())
        return
    name, *rest = arguments
    if name == "--version":
        print(f"histmv {lerobot_histmv.__version__}")
        return
    if name not in COMMANDS:
        close = difflib.get_close_matches(name, COMMANDS, n=1)
        hint = f"; did you mean {close[0]!r}?" if close else ""
        print(f"histmv: unknown command {name!r}{hint} (commands: {', '.join(COMMANDS)})", file=sys.stderr)
        sys.exit(2)
    try:
        dispatch(name, rest)
    except KeyboardInterrupt:
        sys.exit(130)
    except user_errors() as error:
        if os.environ.get(TRACEBACK_VARIABLE):
            raise
        fail(name, error)
