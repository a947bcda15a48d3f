"""The real pipeline from the first recorded frame to the report, in the smallest form that runs every part of it."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from dataset_tools.demo_figures import read_losses

SCENES = 2


def demo(folder: Path) -> str:
    """Run the demo in ``folder``; returns what it prints."""
    command = ["demo", f"--output={folder}", "--episodes=3", f"--scenes={SCENES}", "--preset=train/debug"]
    result = subprocess.run(
        [Path(sys.executable).parent / "histmv", *command], capture_output=True, text=True, env=os.environ
    )
    assert result.returncode == 0, result.stdout + result.stderr
    return result.stdout


@pytest.mark.slow
def test_record_keyframe_train_evaluate_report(tmp_path: Path) -> None:
    folder = tmp_path / "demo"
    printed = demo(folder)
    losses = read_losses((folder / "logs" / "train.log").read_text().splitlines())
    assert losses.steps == [1, 2, 3, 4, 5]
    overall = json.loads((folder / "evaluation" / "eval_info.json").read_text())["overall"]
    assert overall["n_episodes"] == SCENES
    page = (folder / "index.html").read_text()
    assert f"of {SCENES} unseen scenes succeeded" in page
    assert page.count("<video") == SCENES
    assert printed.splitlines()[-1] == f"Look at {folder / 'index.html'}"
    assert "Traceback" not in printed
    assert demo(folder).count("done before") == 5
