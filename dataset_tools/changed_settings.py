"""Refusing to go on with a dataset in the making that other settings began."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any


def refuse_changes(mine: Mapping[str, Any], found: Mapping[str, Any], where: Path, advice: str) -> None:
    """Raise ValueError if the settings ``found`` at ``where`` are not ``mine``, naming each, then ``advice``."""
    changes = [
        f"{name} was {found.get(name)!r} and is now {mine[name]!r}" for name in mine if found.get(name) != mine[name]
    ]
    if changes:
        raise ValueError(f"{where} was made with other settings: {', '.join(changes)}; {advice}")
