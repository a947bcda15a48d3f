"""Cards of policies as people get them: what ``histmv push`` writes, and the commands in it."""

import shlex
from pathlib import Path

from huggingface_hub import ModelCard

from dataset_tools import cli
from dataset_tools.hub import card


def pushed(checkpoint: Path, *options: str) -> ModelCard:
    """The card that ``histmv push --upload=false`` writes."""
    cli.main(["push", "--repo_id=ann/policy", f"--root={checkpoint}", "--upload=false", *options])
    return ModelCard.load(checkpoint / card.CARD_FILE)


def commands_in(text: str, section: str) -> dict[str, list[str]]:
    """Options of the commands in a section of a card, by program."""
    block = text.partition(f"## {section}\n")[2].split("```")[1].removeprefix("bash").replace("\\\n", " ")
    found = {}
    for words in map(shlex.split, block.strip().splitlines()):
        options = [word for word in words if word.startswith("--")]
        found[" ".join(words[: len(words) - len(options)])] = options
    return found
