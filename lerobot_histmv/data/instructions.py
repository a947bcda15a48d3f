"""Paraphrases of the recorded instructions (``meta/instructions.json``)."""

import json
from collections.abc import Iterable
from pathlib import Path

from lerobot_histmv import keys


def load_paraphrases(root: Path | str, recorded: Iterable[str]) -> dict[str, list[str]]:
    """Recorded instruction -> its paraphrases, itself among them; datasets without the file have no others.

    Args:
        root: folder of the dataset.
        recorded: the dataset's task strings.

    Raises:
        ValueError: the file is not a table of lists of sentences.
    """
    path = Path(root) / keys.INSTRUCTIONS_FILE
    table = json.loads(path.read_text()) if path.is_file() else {}
    sound = isinstance(table, dict) and all(
        isinstance(options, list) and all(isinstance(o, str) for o in options) for options in table.values()
    )
    if not sound:
        raise ValueError(f"{path} must map each recorded instruction to a list of sentences")
    return {sentence: list(dict.fromkeys([sentence, *table.get(sentence, [])])) for sentence in recorded}
