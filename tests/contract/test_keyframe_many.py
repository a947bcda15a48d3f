"""Keyframing in pieces gives what keyframing at once gives, here and through Slurm; finished pieces stay."""

import json
import os
import stat
import sys
from dataclasses import asdict
from pathlib import Path

import pyarrow.parquet as pq
import pytest
from helpers.episodes import write_vector_picks
from lerobot.datasets import LeRobotDataset
from rich.console import Console

from dataset_tools import cli
from dataset_tools.keyframes import Keyframing
from dataset_tools.many import merge
from dataset_tools.many import pieces as many_pieces
from lerobot_histmv import keys

EPISODES, PIECES = 7, 3

pytest.importorskip("datatrove")


def arguments(dense: Path, output: Path) -> list[str]:
    places = ["--dataset.repo_id=test/dense", f"--dataset.root={dense}", "--output.repo_id=test/keys"]
    return [*places, f"--output.root={output}", "--epsilon=0.003"]


@pytest.fixture(scope="module")
def dense(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_vector_picks(tmp_path_factory.mktemp("dense") / "dense", count=EPISODES)


@pytest.fixture(scope="module")
def at_once(dense: Path) -> Path:
    root = dense.parent / "at_once"
    cli.main(["keyframe", *arguments(dense, root)])
    return root


def assert_same(root: Path, expected: Path) -> None:
    """The same rows, statistics, tasks and keyframes; only processor times may differ."""
    mine, other = (LeRobotDataset("test/keys", root=place) for place in (root, expected))
    rows = [pq.read_table(place / "data").to_pylist() for place in (root, expected)]
    assert rows[0] == rows[1]
    assert mine.meta.total_episodes == other.meta.total_episodes == EPISODES
    assert mine.meta.tasks.equals(other.meta.tasks)
    assert mine.meta.episodes["length"] == other.meta.episodes["length"]
    reports = [json.loads((place / keys.KEYFRAMING_FILE).read_text()) for place in (root, expected)]
    for report in reports:
        del report["totals"]["seconds_per_episode"]
        for episode in report["episodes"]:
            del episode["seconds"]
        report["notices"] = []  # at once it is told that the gripper's ends were found; pieces are given them
    assert reports[0] == reports[1]


def test_pieces_give_what_one_run_gives(dense: Path, at_once: Path, tmp_path: Path) -> None:
    cli.main(["keyframe-many", *arguments(dense, tmp_path / "keys"), f"--pieces={PIECES}", "--workers=1"])
    assert_same(tmp_path / "keys", at_once)
    assert [path.name for path in tmp_path.iterdir()] == ["keys"]


def test_pieces_merged_in_groups_of_groups_give_the_same(
    dense: Path, at_once: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(merge, "AT_ONCE", 2)  # seven pieces become four, two, one
    cli.main(["keyframe-many", *arguments(dense, tmp_path / "keys"), f"--pieces={EPISODES}", "--workers=1"])
    assert_same(tmp_path / "keys", at_once)
    assert [path.name for path in tmp_path.iterdir()] == ["keys"]


def test_episodes_tell_the_file_they_lie_in_when_there_are_several(
    dense: Path, at_once: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(merge, "EPISODES_FILE_MB", 0)
    cli.main(["keyframe-many", *arguments(dense, tmp_path / "keys"), f"--pieces={PIECES}", "--workers=1"])
    assert_same(tmp_path / "keys", at_once)
    files = sorted((tmp_path / "keys").glob(merge.EPISODES_FILES))
    told = [set(pq.read_table(file).column("meta/episodes/file_index").to_pylist()) for file in files]
    assert told == [{number} for number in range(PIECES)]


def test_a_stopped_run_goes_on_with_the_missing_pieces(
    dense: Path, at_once: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    command = ["keyframe-many", *arguments(dense, tmp_path / "keys"), f"--pieces={PIECES}", "--workers=1"]
    begun: list[tuple[int, ...]] = []
    real = many_pieces.keyframe_dataset

    def run_or_stop(config: many_pieces.KeyframeConfig, console: Console) -> None:
        begun.append(tuple(config.dataset.episodes or ()))
        if len(begun) == PIECES:
            raise KeyboardInterrupt
        real(config, console)

    monkeypatch.setattr(many_pieces, "keyframe_dataset", run_or_stop)
    with pytest.raises((KeyboardInterrupt, SystemExit)):
        cli.main(command)
    assert not (tmp_path / "keys").exists()
    with pytest.raises(SystemExit):
        cli.main([*command, "--epsilon=0.004"])
    cli.main(command)
    assert begun == [(0, 1, 2), (3, 4), (5, 6), (5, 6)]
    assert_same(tmp_path / "keys", at_once)


def test_the_merged_report_holds_one_piece_at_a_time(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    numbers, roots = ((0, 2), (3, 5, 7)), [tmp_path / name for name in "ab"]
    found = {
        number: Keyframing((), number + 11, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, "") for pair in numbers for number in pair
    }
    for root, own in zip(roots, numbers, strict=True):
        (root / "meta").mkdir(parents=True)
        told = {"episodes": [{"source_episode": number, **asdict(found[number])} for number in own]}
        (root / keys.KEYFRAMING_FILE).write_text(json.dumps(told))
    read: list[Path] = []
    real = merge.told_by
    monkeypatch.setattr(merge, "told_by", lambda root: read.append(root) or real(root))
    lazy = merge.PiecesKeyframings(roots)
    assert len(lazy) == len(found)
    for _ in range(2):
        assert list(lazy.items()) == list(found.items())
    assert read == [*roots, *roots, *roots]  # to know the numbers, then once in each pass


SBATCH = """#!{python}
import os, re, subprocess, sys
text = open(sys.argv[-1]).read()
log = open(os.environ["FAKE_SLURM"], "a")
print(sys.argv[1:-1], file=log, flush=True)
if "merge_stats" not in text:
    for task in range(int(re.search("--array=0-([0-9]+)", text)[1]) + 1):
        variables = os.environ | {{"SLURM_ARRAY_TASK_ID": str(task), "SLURM_NODELIST": "here"}}
        subprocess.run(["bash", sys.argv[-1]], env=variables, stdout=log, stderr=log, check=True)
print("Submitted batch job", 41)
"""
SRUN = """#!/bin/sh
while [ "${1#-}" != "$1" ]; do
  case "$1" in -n) shift ;; esac
  shift
done
exec "$@"
"""


def test_slurm_gets_a_job_per_piece_and_one_that_merges(
    dense: Path, at_once: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    commands = {"sbatch": SBATCH.format(python=sys.executable), "srun": SRUN, "scontrol": "#!/bin/sh\necho here\n"}
    for name, text in commands.items():
        script = tmp_path / "bin" / name
        script.parent.mkdir(exist_ok=True)
        script.write_text(text)
        script.chmod(script.stat().st_mode | stat.S_IEXEC)
    monkeypatch.setenv("PATH", f"{tmp_path}/bin:{Path(sys.executable).parent}:{os.environ['PATH']}")
    monkeypatch.setenv("FAKE_SLURM", str(tmp_path / "slurm.log"))
    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).parents[2]))
    slurm = ["--engine=slurm", "--slurm.partition=cpu", "--pieces=2"]
    cli.main(["keyframe-many", *arguments(dense, tmp_path / "keys"), *slurm])
    assert_same(tmp_path / "keys", at_once)
    assert "--dependency=afterok:41" in (tmp_path / "slurm.log").read_text()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--pieces=0"], "pieces is 0; it must be at least 1"),
        (["--engine=slurm"], "slurm.partition is empty"),
        (["--engine=ray"], "ray"),
    ],
)
def test_wrong_options_are_told(
    dense: Path, tmp_path: Path, options: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit):
        cli.main(["keyframe-many", *arguments(dense, tmp_path / "keys"), *options])
    assert message in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []
