"""Every recorded instruction finds its paraphrases, whatever the dataset says about them."""

import json
from pathlib import Path

import pytest

from lerobot_histmv import keys
from lerobot_histmv.data.instructions import load_paraphrases, meanings


def stored(root: Path, content: object) -> Path:
    path = root / keys.INSTRUCTIONS_FILE
    path.parent.mkdir()
    path.write_text(content if isinstance(content, str) else json.dumps(content))
    return root


def test_the_recorded_wording_comes_first_and_once(tmp_path: Path) -> None:
    root = stored(tmp_path, {"lift the cube": ["raise the cube", "lift the cube"], "unused": ["never"]})
    found = load_paraphrases(root, ["lift the cube", "wave"])
    assert found == {"lift the cube": ["lift the cube", "raise the cube"], "wave": ["wave"]}


def test_a_dataset_without_paraphrases_has_its_own_wording(tmp_path: Path) -> None:
    assert load_paraphrases(tmp_path, ["wave"]) == {"wave": ["wave"]}


@pytest.mark.parametrize("content", ["{", ["wave"], {"wave": "hello"}, {"wave": [""]}, {"wave": [3]}])
def test_malformed_files_are_named(tmp_path: Path, content: object) -> None:
    with pytest.raises(ValueError, match=r"instructions\.json .* recorded instruction -> list of paraphrases"):
        load_paraphrases(stored(tmp_path, content), ["wave"])


def test_lists_that_share_a_sentence_mean_the_same() -> None:
    paraphrases = {"lift": ["lift", "raise"], "wave": ["wave"], "hoist": ["hoist", "elevate"], "up": ["raise", "hoist"]}
    assert meanings(paraphrases) == [["elevate", "hoist", "lift", "raise"], ["wave"]]
