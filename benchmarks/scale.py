"""Is the cost of an episode the same among 100 and among 10,000? Keyframing of low-dimensional episodes.

    python benchmarks/scale.py [--sizes 100 1000 10000] [--folder=outputs/scale]

Makes a dense dataset of each size (paths of ``paths.py``, rotation, gripper; no images), keyframes it with
``histmv keyframe-many`` in pieces of 500 episodes, one process, and tells seconds and processor time per episode, and
the largest memory. A dataset that is there is not made again. Results go to ``benchmarks/results/scale.json``.
"""

import argparse
import resource
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from lerobot.datasets.feature_utils import get_hf_features_from_features
from paths import human
from scipy.spatial.transform import Rotation
from tqdm import tqdm

from dataset_tools.assembly import Episode, write_dataset
from dataset_tools.shards import write_json
from lerobot_histmv import keys
from lerobot_histmv.geometry import canonical

RESULTS = Path(__file__).parent / "results" / "scale.json"
FRAMES, FPS = 200, 20
FEATURES = {
    key: {"dtype": "float32", "shape": (8,), "names": list(keys.POSE_NAMES)} for key in (keys.STATE, keys.ACTION)
}


def episode(number: int) -> Episode:
    """A synthetic demonstration: reaches, a slow turn, the gripper closing and opening once."""
    rng = np.random.default_rng(number)
    close, reopen = np.sort(rng.integers(40, FRAMES - 40, 2))
    turn = np.outer(np.linspace(0, 1, FRAMES), rng.normal(0, 0.6, 3))
    gripper = ((np.arange(FRAMES) < close) | (np.arange(FRAMES) >= reopen)).astype(np.float64)
    quaternion = canonical(Rotation.from_rotvec(turn).as_quat(scalar_first=True))
    pose = np.column_stack([human(FRAMES, rng), quaternion, gripper]).astype(np.float32)
    schema = get_hf_features_from_features(FEATURES).arrow_schema
    table = pa.table([pa.array(list(pose), field.type) for field in schema], schema=schema)
    return Episode(table, [f"follow path {number % 7}"] * FRAMES, {})


def make(root: Path, episodes: int) -> None:
    """Write the dense dataset, if it is not there."""

    def all_of_them() -> Iterator[Episode]:
        yield from map(episode, tqdm(range(episodes), desc=f"making {episodes} episodes"))

    if not root.exists():
        partial = root.with_name(f"{root.name}.partial")
        shutil.rmtree(partial, ignore_errors=True)
        write_dataset(all_of_them(), FEATURES, FPS, "local/scale", partial, None)
        partial.rename(root)


def measure(folder: Path, episodes: int) -> dict[str, Any]:
    """Keyframe one size."""
    dense, output = folder / f"dense_{episodes}", folder / f"keyframes_{episodes}"
    make(dense, episodes)
    shutil.rmtree(output, ignore_errors=True)
    shutil.rmtree(output.with_name(f"{output.name}.pieces"), ignore_errors=True)
    command = [
        str(Path(sys.executable).parent / "histmv"), "keyframe-many", "--dataset.repo_id=local/scale",
        f"--dataset.root={dense}", "--output.repo_id=local/scale_keyframes", f"--output.root={output}",
        f"--pieces={max(1, episodes // 500)}", "--workers=1",
    ]  # fmt: skip
    before, begin = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    wall, after = time.perf_counter() - begin, resource.getrusage(resource.RUSAGE_CHILDREN)
    spent = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return {
        "episodes": episodes,
        "seconds": round(wall, 1),
        "ms_per_episode": round(1000 * wall / episodes, 1),
        "processor_ms_per_episode": round(1000 * spent / episodes, 1),
        "largest_memory_mb": round(after.ru_maxrss / 1024),
    }


def main() -> None:
    """Measure every size, smallest first."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--sizes", nargs="+", type=int, default=[100, 1000, 10_000])
    parser.add_argument("--folder", type=Path, default=Path("outputs/scale"))
    args = parser.parse_args()
    args.folder.mkdir(parents=True, exist_ok=True)
    rows = []
    for size in sorted(args.sizes):
        rows.append(measure(args.folder, size))
        print(rows[-1], flush=True)
    write_json(RESULTS, {"frames_per_episode": FRAMES, "processes": 1, "sizes": rows})


if __name__ == "__main__":
    main()
