"""Variations and their instructions: enough paraphrases, nothing ambiguous, and some kept back."""

from collections import Counter

import pytest

from lerobot_histmv.envs import TASKS
from lerobot_histmv.envs.tasks.base import SPLITS
from lerobot_histmv.envs.tasks.colors import COLORS, HELD_OUT_COLORS


@pytest.mark.parametrize("name", TASKS)
def test_every_variation_has_its_own_paraphrases(name: str) -> None:
    task = TASKS[name]
    owners = Counter()
    for variation in range(len(task.variations)):
        train, held_out = (task.instructions(variation, split) for split in SPLITS)
        assert len(train) >= 5
        assert len(held_out) >= 3
        owners.update(train + held_out)
    assert set(owners.values()) == {1}


@pytest.mark.parametrize("name", TASKS)
def test_an_instruction_names_its_colours_in_order_and_no_other(name: str) -> None:
    task = TASKS[name]
    for variation, goal in enumerate(task.variations):
        for split in SPLITS:
            for sentence in task.instructions(variation, split):
                words = sentence.replace(",", "").split()
                assert tuple(word for word in words if word in COLORS) == tuple(w for w in goal if w in COLORS)
                assert not set(words) & set(HELD_OUT_COLORS) or name == "pick_and_lift_unseen_colors"


@pytest.mark.parametrize("name", TASKS)
def test_variations_are_distinct(name: str) -> None:
    task = TASKS[name]
    assert len(set(task.variations)) == len(task.variations)
    for goal in task.variations:
        assert len(set(goal)) == len(goal)


def test_buttons_use_every_colour_equally_often_at_every_place() -> None:
    for length in (1, 2, 3):
        sequences = [goal for goal in TASKS["push_buttons"].variations if len(goal) == length]
        for place in range(length):
            assert Counter(goal[place] for goal in sequences) == dict.fromkeys(COLORS, 1)
