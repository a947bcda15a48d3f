"""The page of tasks says what the classes say."""

import inspect
from pathlib import Path

import pytest

from lerobot_histmv.envs import TASKS

DOCS = Path(__file__).parents[2] / "docs"
ROWS = ("objects", "scene", "variations", "success", "failure", "macro steps", "difficulty")


@pytest.mark.parametrize("name", TASKS)
def test_a_task_is_specified_and_shown(name: str) -> None:
    text = inspect.getdoc(TASKS[name])
    assert [row for row in ROWS if f"\n| {row} | " not in text] == []
    page = (DOCS / "tasks.md").read_text(encoding="utf-8")
    assert f"### `{name}`\n" in page
    assert text in page, "python examples/draw_tasks.py writes the page anew"
    for kind in ("png", "webp"):
        assert (DOCS / "images" / "tasks" / f"{name}.{kind}").is_file()


@pytest.mark.parametrize("name", TASKS)
def test_the_declared_macro_steps_are_the_documented_ones(name: str) -> None:
    task = TASKS[name]
    (row,) = [line for line in inspect.getdoc(task).splitlines() if line.startswith("| macro steps |")]
    numbers = row.split("|")[2].split(":")[0]
    declared = {str(task.macro_steps(variation)) for variation in range(len(task.variations))}
    assert {number.strip() for number in numbers.split(",")} == declared
