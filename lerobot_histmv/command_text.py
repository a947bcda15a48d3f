"""Commands in cards: one option a line, quoted for the shell, and written as draccus reads them."""

import json
import shlex
from collections.abc import Iterator, Mapping
from typing import Any

AGAIN = "again"
"""Folder, where the reader is, in which a card's commands make everything again."""
DEMONSTRATIONS, KEYFRAMES, TRAINING = (f"{AGAIN}/{name}" for name in ("demonstrations", "keyframes", "training"))
INSTALL = "pip install 'lerobot_policy_histmv[sim]'  # or '.[sim]' in a checkout of the project"
"""First of the commands in every card."""


def command(program: str, options: Mapping[str, Any]) -> str:
    """``program`` with ``--name=value`` for each of the options."""
    words = [f"--{name}={plain(value)}" for name, value in options.items()]
    return " \\\n  ".join([program, *map(shlex.quote, words)])


def plain(value: Any) -> str:
    """A value as draccus reads it: text as it is, else JSON whose text and keys have no quotes."""
    return value if isinstance(value, str) else json.dumps(value, separators=(",", ": ")).replace('"', "")


def flat(options: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Names, with dots, and values of nested options."""
    for name, value in options.items():
        if isinstance(value, Mapping):
            yield from flat(value, f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}", value
