"""Paraphrases of a dataset's instructions."""

import json
from collections.abc import Iterable
from pathlib import Path

from lerobot_histmv import keys


def load_paraphrases(root: str | Path, recorded: Iterable[str]) -> dict[str, list[str]]:
    """Recorded instruction -> its paraphrases, itself included, for every one of ``recorded``.

    A dataset without ``meta/instructions.json``, or an instruction that it does not name, has no other wording.

    Raises:
        ValueError: the file is no JSON object of lists of non-empty strings.
    """
    path = Path(root) / keys.INSTRUCTIONS_FILE
    stored = _read(path) if path.is_file() else {}
    return {task: list(dict.fromkeys([task, *stored.get(task, [])])) for task in recorded}


def meanings(paraphrases: dict[str, list[str]]) -> list[list[str]]:
    """All wordings, sorted and grouped by what they mean: lists that share a sentence mean the same."""
    groups: list[set[str]] = []
    for wordings in paraphrases.values():
        same = [group for group in groups if not group.isdisjoint(wordings)]
        groups = [group for group in groups if group not in same] + [set(wordings).union(*same)]
    return sorted(sorted(group) for group in groups)


def _read(path: Path) -> dict[str, list[str]]:
    expected = "it must be a JSON object: recorded instruction -> list of paraphrases"
    try:
        stored = json.loads(path.read_text(encoding="utf-8"))
    except ValueError as error:
        raise ValueError(f"{path} is no JSON ({error}); {expected}") from error
    if not isinstance(stored, dict):
        raise ValueError(f"{path} holds a {type(stored).__name__}; {expected}")
    for instruction, paraphrases in stored.items():
        if not isinstance(paraphrases, list) or not all(isinstance(text, str) and text for text in paraphrases):
            raise ValueError(f"{path} gives {instruction!r} the paraphrases {paraphrases!r}; {expected}")
    return stored
