"""Kill -9 at random moments: is any finished episode ever lost, and is the result that of an undisturbed run?

    python benchmarks/kills.py DENSE [--kills=50] [--folder=outputs/kills]

Keyframes the dataset at DENSE once undisturbed, then again in two processes, killed after a random time and started
again, until ``--kills`` of them were killed. After each kill all finished episodes must still be there, byte for byte;
a run that finishes before its kill is compared and begun again. Results go to ``benchmarks/results/kills.json``.
"""

import argparse
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from hashlib import sha256
from pathlib import Path

import pyarrow.parquet as pq
from tqdm import tqdm

from dataset_tools.shards import write_json

RESULTS = Path(__file__).parent / "results" / "kills.json"
KILLED_WITHIN = 0.25
"""Share of an undisturbed run's time in which one is killed; both count from the first newly finished episode."""


def start(dense: Path, output: Path) -> subprocess.Popen:
    """``histmv keyframe`` in a process group of its own."""
    command = [
        str(Path(sys.executable).parent / "histmv"), "keyframe", "--dataset.repo_id=local/dense",
        f"--dataset.root={dense}", "--output.repo_id=local/keys", f"--output.root={output}", "--workers=2",
    ]  # fmt: skip
    return subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, start_new_session=True)


def finished(parts: Path) -> set[str]:
    """Names of the finished episodes' files."""
    return {path.name for path in parts.glob("episode-*.parquet")}


def digests(parts: Path) -> dict[str, str]:
    """Content of the finished episodes' files."""
    return {name: sha256((parts / name).read_bytes()).hexdigest() for name in finished(parts)}


def begun(dense: Path, output: Path) -> subprocess.Popen:
    """A run that has just finished one more episode, or ended."""
    parts, run = output.with_name(f"{output.name}.parts"), start(dense, output)
    before = finished(parts)
    while run.poll() is None and finished(parts) <= before and not output.exists():
        time.sleep(0.02)
    return run


def undisturbed(dense: Path, output: Path) -> float:
    """Seconds that a whole run takes from its first finished episode on."""
    run, start = begun(dense, output), time.monotonic()
    if run.wait() != 0:
        raise RuntimeError(f"histmv keyframe fails on {dense}")
    return time.monotonic() - start


def killed(dense: Path, output: Path, seconds: float) -> bool:
    """One run, killed with all its processes after so long; False if it finished before."""
    parts, run = output.with_name(f"{output.name}.parts"), begun(dense, output)
    deadline = time.monotonic() + seconds
    while run.poll() is None and time.monotonic() < deadline:
        time.sleep(0.02)
    if run.poll() is None:
        os.killpg(run.pid, signal.SIGKILL)
    if run.wait() not in (0, -signal.SIGKILL):
        raise RuntimeError(f"histmv keyframe refused to go on: {run.returncode}; see {parts}")
    return run.returncode != 0


def rows(root: Path) -> list[dict]:
    """All rows of a dataset."""
    return [row for path in sorted(root.glob("data/*/*.parquet")) for row in pq.read_table(path).to_pylist()]


def main() -> None:
    """Kill, check, tell."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("dense", type=Path)
    parser.add_argument("--kills", type=int, default=50)
    parser.add_argument("--folder", type=Path, default=Path("outputs/kills"))
    args = parser.parse_args()
    shutil.rmtree(args.folder, ignore_errors=True)
    args.folder.mkdir(parents=True)
    whole, output = args.folder / "undisturbed", args.folder / "killed"
    longest = KILLED_WITHIN * undisturbed(args.dense, whole)
    chance, lost, completed = random.Random(0), 0, 0
    parts, bar = output.with_name(f"{output.name}.parts"), tqdm(total=args.kills, unit="kill")
    while bar.n < args.kills:
        before = digests(parts)
        bar.update(killed(args.dense, output, chance.uniform(0, longest)))
        if output.exists():  # finished, perhaps killed just after: begin again
            completed += 1
            lost += rows(output) != rows(whole)
            shutil.rmtree(output)
        else:
            after = digests(parts)
            lost += sum(after.get(name) != digest for name, digest in before.items())
    if start(args.dense, output).wait() != 0:
        raise RuntimeError(f"histmv keyframe refused to go on; see {parts}")
    same = rows(output) == rows(whole)
    write_json(RESULTS, {"kills": bar.n, "finished_runs": completed, "lost_episodes": lost, "same_result": same})
    print(RESULTS.read_text())


if __name__ == "__main__":
    main()
