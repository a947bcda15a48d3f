"""How fast the tasks run: physics, and three RGB-D pictures of 128 x 128 per macro step, on one core and on two.

    python benchmarks/environment_speed.py [--tasks turn_tap water_plants] [--episodes=3]

Per task: macro-step observations per second on one core, the share of rendering in it, and the same pictures from
``mujoco.Renderer`` with the stock meshes as the peer. For ``pick_and_lift``: demonstrations per minute as key poses in
two processes, and how much two environments in processes of their own give over one. Results go to
``benchmarks/results/environment_speed.json``; they mean something on an idle machine only.
"""

import argparse
import json
import multiprocessing
import os
import time
from pathlib import Path
from typing import Any

os.environ |= {"LP_NUM_THREADS": "1", "OMP_NUM_THREADS": "1", "MUJOCO_GL": os.environ.get("MUJOCO_GL", "egl")}

import mujoco
import numpy as np
from tqdm import tqdm

from dataset_tools.shards import write_json
from lerobot_histmv.envs import TASKS, UR5Env, make, scene
from lerobot_histmv.envs.camera import CAMERAS
from lerobot_histmv.envs.configuration_ur5 import UR5EnvConfig

RESULTS = Path(__file__).parent / "results" / "environment_speed.json"
SEED = 500_000
SIZE = 128
DEMONSTRATED = "pick_and_lift"
EPISODES, STEPS, REPETITIONS = 12, 4, 9


def demonstrate(env: UR5Env, seed: int) -> int:
    """One episode in macro steps; how many observations there were, the first one included."""
    env.reset(seed=seed)
    observations = 1
    for motion in env.expert():
        for action in motion.actions(env.stage.controller.gripper):
            *_, terminated, truncated, _ = env.step(action)
            observations += 1
            if terminated or truncated:
                return observations
    return observations


def speed(task: str, episodes: int) -> dict[str, float]:
    """Macro-step observations per second of one process, and how long the pictures of one take."""
    env = make(task, image_size=SIZE)
    env.reset(seed=SEED)
    begin = time.perf_counter()
    observations = sum(demonstrate(env, SEED + episode) for episode in range(episodes))
    seconds = time.perf_counter() - begin
    begin = time.perf_counter()
    for _ in range(20):
        env.observe()
    observing = (time.perf_counter() - begin) / 20
    env.close()
    return {
        "observations_per_second": round(observations / seconds, 1),
        "observe_ms": round(1000 * observing, 1),
        "share_of_rendering": round(observing * observations / seconds, 2),
    }


def stock_renderer_ms(task: str) -> float:
    """Milliseconds of the same pictures from ``mujoco.Renderer``, twice per camera (depth is a second render)."""
    decimate, scene._use_meshes = scene._use_meshes, stock_meshes
    try:
        model = scene.build_model(TASKS[task].objects, SIZE)
    finally:
        scene._use_meshes = decimate
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    with mujoco.Renderer(model, SIZE, SIZE) as renderer:
        begin = time.perf_counter()
        for _ in range(3):
            for camera in CAMERAS.values():
                for depth in (False, True):
                    renderer.enable_depth_rendering() if depth else renderer.disable_depth_rendering()
                    renderer.update_scene(data, camera)
                    renderer.render()
    return round(1000 * (time.perf_counter() - begin) / 3, 1)


def stock_meshes(spec: mujoco.MjSpec, folder: Path) -> None:
    """Keep Menagerie's meshes, named by full paths."""
    for mesh in spec.meshes:
        mesh.file = str(Path(spec.modelfiledir) / spec.meshdir / mesh.file)
    spec.meshdir = ""


def record_some(seeds: range) -> int:
    """Demonstrations in one process; observations at the key poses only."""
    env = make(DEMONSTRATED, image_size=SIZE)
    for seed in seeds:
        demonstrate(env, seed)
    env.close()
    return len(seeds)


def demonstrations_per_minute(episodes: int) -> float:
    """Key-pose demonstrations of two processes, their start included."""
    begin = time.perf_counter()
    halves = (range(SEED, SEED + episodes), range(SEED + episodes, SEED + 2 * episodes))
    with multiprocessing.get_context("spawn").Pool(2) as pool:
        count = sum(pool.map(record_some, halves))
    return round(60 * count / (time.perf_counter() - begin), 1)


def vector_observations_per_second(count: int) -> float:
    """Observations per second of ``count`` environments in processes of their own; episodes of a few steps."""
    config = UR5EnvConfig(task=DEMONSTRATED)
    (vector,) = config.create_envs(count, use_async_envs=True)[DEMONSTRATED].values()
    poses = np.array([[0.4, y, 0.2, 1, 0, 0, 0, 1] for y in (-0.2, 0.2)], np.float32)
    vector.reset(seed=list(range(count)))
    begin = time.perf_counter()
    for episode in range(EPISODES):
        vector.reset(seed=[episode * count + place for place in range(count)])
        for step in range(STEPS):
            *_, terminated, truncated, _ = vector.step(np.repeat(poses[step % 2][None], count, axis=0))
            if np.any(terminated | truncated):  # an environment that is done does nothing more
                raise RuntimeError(f"an episode is over after step {step}; fewer STEPS are needed")
    rate = EPISODES * (STEPS + 1) * count / (time.perf_counter() - begin)
    vector.close()
    return rate


def busy_loop(_: int) -> float:
    """Seconds of a plain loop that needs neither memory nor another process."""
    begin = time.perf_counter()
    total = 0
    for number in range(10**7):
        total += number
    return time.perf_counter() - begin


def two_loops_over_one() -> float:
    """What a second core gives at most on this machine: plain loops, median of interleaved repetitions."""
    with multiprocessing.get_context("spawn").Pool(2) as pool:
        pairs = [(max(pool.map(busy_loop, [0])), max(pool.map(busy_loop, [0, 0], 1))) for _ in range(REPETITIONS)]
    return round(float(np.median([2 * one / two for one, two in pairs])), 2)


def two_environments_over_one() -> float:
    """Median of the gain over interleaved repetitions."""
    pairs = [(vector_observations_per_second(1), vector_observations_per_second(2)) for _ in range(REPETITIONS)]
    return round(float(np.median([two / one for one, two in pairs])), 2)


def main() -> None:
    """Measure and write down."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--tasks", nargs="*", choices=TASKS, default=list(TASKS))
    parser.add_argument("--episodes", type=int, default=3)
    args = parser.parse_args()
    results: dict[str, Any] = json.loads(RESULTS.read_text()) if RESULTS.is_file() else {"tasks": {}}
    results["load_before"] = round(os.getloadavg()[0], 1)
    for task in tqdm(args.tasks, unit="task"):
        results["tasks"][task] = speed(task, args.episodes) | {"stock_renderer_ms": stock_renderer_ms(task)}
    results["demonstrations_per_minute"] = demonstrations_per_minute(100)
    results["two_loops_over_one"] = two_loops_over_one()
    results["two_environments_over_one"] = two_environments_over_one()
    write_json(RESULTS, results)
    print(json.dumps(results, indent=2))


if __name__ == "__main__":
    main()
