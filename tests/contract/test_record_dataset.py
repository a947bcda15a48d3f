"""A recorded dataset is what LeRobot itself would have written, and LeRobot's tools work on it."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from fake_demonstrations import CAMERAS, FAILING_SEEDS, PARAPHRASES, SIZE, TICKS_PER_MOTION, FakeEnv
from lerobot.datasets import LeRobotDataset
from lerobot.datasets.compute_stats import get_feature_stats, sample_indices
from lerobot.datasets.dataset_tools import delete_episodes, merge_datasets, split_dataset
from lerobot.datasets.io_utils import load_stats

from dataset_tools.assembly import assemble
from dataset_tools.dense_features import ROBOT_TYPE, dense_features
from dataset_tools.images import image_statistics
from dataset_tools.record_worker import Demonstration, Worker, WorkerSetup, dealt
from dataset_tools.shards import Outcome
from lerobot_histmv import keys

FPS = 20
SEEDS = (0, 1, 3)
FEATURES = dense_features(CAMERAS, SIZE)
REPO_ID = "local/fake"


@pytest.fixture(scope="module")
def outcomes_and_fast(tmp_path_factory: pytest.TempPathFactory) -> tuple[list[Outcome], LeRobotDataset]:
    directory = tmp_path_factory.mktemp("fast")
    worker = Worker(WorkerSetup(directory, ("lift",), FakeEnv, CAMERAS, stride=1, seed=0))
    outcomes = [worker.make_attempt(seed) for seed in SEEDS]
    assemble(directory, outcomes, FEATURES, FPS, REPO_ID, directory / "dataset")
    return outcomes, LeRobotDataset(REPO_ID, root=directory / "dataset")


@pytest.fixture(scope="module")
def fast(outcomes_and_fast: tuple[list[Outcome], LeRobotDataset]) -> LeRobotDataset:
    return outcomes_and_fast[1]


@pytest.fixture(scope="module")
def stock(tmp_path_factory: pytest.TempPathFactory) -> LeRobotDataset:
    root = tmp_path_factory.mktemp("stock") / "dataset"
    dataset = LeRobotDataset.create(REPO_ID, FPS, FEATURES, root=root, robot_type=ROBOT_TYPE, use_videos=False)
    env = FakeEnv()
    for seed in SEEDS:
        _, info = env.reset(seed=seed, options={"variation": dealt(env.variations, SEEDS[0], turn=seed)})
        demonstration = Demonstration(env, CAMERAS, stride=1)
        assert demonstration.run() == ""
        for frame, action in zip(demonstration.frames, demonstration.actions, strict=True):
            dataset.add_frame({**frame, keys.ACTION: action, "task": info["instruction"]})
        dataset.save_episode()
    dataset.finalize()
    return LeRobotDataset(REPO_ID, root=root)


def test_samples_are_bit_identical_to_stock_writing(fast: LeRobotDataset, stock: LeRobotDataset) -> None:
    assert len(fast) == len(stock) == len(SEEDS) * 2 * TICKS_PER_MOTION
    for i in range(len(stock)):
        mine, theirs = fast[i], stock[i]
        assert mine.keys() == theirs.keys()
        for key, value in theirs.items():
            if isinstance(value, torch.Tensor):
                assert mine[key].dtype == value.dtype, key
                assert torch.equal(mine[key], value), key
            else:
                assert mine[key] == value, key


def test_metadata_equals_stock_writing(fast: LeRobotDataset, stock: LeRobotDataset) -> None:
    assert fast.meta.info == stock.meta.info
    assert fast.meta.tasks.equals(stock.meta.tasks)
    assert fast.meta.episodes.features == stock.meta.episodes.features
    assert fast.meta.episodes[:] == stock.meta.episodes[:]
    assert fast.hf_dataset.features == stock.hf_dataset.features


def test_statistics_equal_stock_writing(fast: LeRobotDataset, stock: LeRobotDataset) -> None:
    mine, theirs = load_stats(fast.root), load_stats(stock.root)
    assert mine.keys() == theirs.keys()
    for key in theirs:
        assert mine[key].keys() == theirs[key].keys()
        for name, value in theirs[key].items():
            assert mine[key][name].shape == value.shape, (key, name)
            assert mine[key][name] == pytest.approx(value, rel=1e-3, abs=1e-7), (key, name)


@pytest.mark.parametrize("frames", [1, 3, 101, 701])
@pytest.mark.parametrize("shape", [(5, 7), (7, 307)])
def test_image_statistics_equal_lerobots(frames: int, shape: tuple[int, int]) -> None:
    rng = np.random.default_rng(frames)
    step = 2 if max(shape) >= 300 else 1
    for dtype, channels, scale in ((np.uint8, 3, 255), (np.uint16, 1, 1)):
        images = rng.integers(0, 201, (frames, *shape, channels), dtype)
        sampled = images[sample_indices(frames)][:, ::step, ::step].transpose(0, 3, 1, 2)
        theirs = get_feature_stats(sampled, axis=(0, 2, 3), keepdims=True)
        mine = image_statistics(images)
        assert mine.keys() == theirs.keys()
        assert mine["count"] == theirs["count"]
        for name in theirs.keys() - {"count"}:
            tolerance = 2e-2 if name in ("mean", "std") else 1e-6
            assert mine[name] == pytest.approx(theirs[name][0] / scale, rel=tolerance), name


def test_instructions_are_recorded_with_their_paraphrases(
    outcomes_and_fast: tuple[list[Outcome], LeRobotDataset],
) -> None:
    outcomes, fast = outcomes_and_fast
    table = json.loads((fast.root / keys.INSTRUCTIONS_FILE).read_text())
    assert [fast[10 * i]["task"] for i in range(len(SEEDS))] == [outcome.instruction for outcome in outcomes]
    assert set(table) == {outcome.instruction for outcome in outcomes} == set(fast.meta.tasks.index)
    assert all(recorded in paraphrases for recorded, paraphrases in table.items())
    assert all(tuple(paraphrases) in PARAPHRASES for paraphrases in table.values())


@pytest.mark.parametrize(("stride", "expected"), [(1, list(range(10))), (2, [1, 3, 5, 7, 9]), (4, [3, 7, 9])])
def test_a_frame_commands_what_holds_at_its_end(stride: int, expected: list[int]) -> None:
    env = FakeEnv()
    env.reset(seed=0)
    demonstration = Demonstration(env, CAMERAS, stride)
    demonstration.run()
    columns = demonstration.columns()
    assert columns[keys.ACTION][:, 0].tolist() == expected
    for frame, tick in enumerate(range(0, 10, stride)):
        env.ticks = tick
        assert np.array_equal(columns[keys.STATE][frame], env.observe()["agent_pos"])


@pytest.mark.parametrize("count", [1, 5])
@pytest.mark.parametrize("seed", [0, 7])
def test_variations_take_turns_in_random_order(count: int, seed: int) -> None:
    variations = range(3, 3 + count)
    rounds = [[dealt(variations, seed, count * n + place) for place in range(count)] for n in range(11)]
    assert all(sorted(one) == list(variations) for one in rounds)
    assert count == 1 or len({tuple(one) for one in rounds}) > 5


def test_every_task_of_several_deals_its_own_variations(tmp_path: Path) -> None:
    worker = Worker(WorkerSetup(tmp_path, ("lift", "push", "pull"), FakeEnv, CAMERAS, stride=1, seed=0))
    outcomes = [worker.make_attempt(attempt) for attempt in range(3 * len(PARAPHRASES))]
    for task in worker.setup.tasks:
        assert sorted(one.variation for one in outcomes if one.task == task) == list(range(len(PARAPHRASES)))


def test_failed_attempts_leave_only_their_reason(tmp_path: Path) -> None:
    worker = Worker(WorkerSetup(tmp_path, ("lift",), FakeEnv, CAMERAS, stride=1, seed=FAILING_SEEDS[0]))
    outcome = worker.make_attempt(0)
    assert (outcome.failure, outcome.seed, outcome.success) == ("grasp missed", FAILING_SEEDS[0], False)
    assert [path.suffix for path in tmp_path.iterdir()] == [".json"]


def test_unreachable_targets_are_failures_of_the_arm(tmp_path: Path) -> None:
    class Unreachable(FakeEnv):
        def execute(self, motion: int, on_tick: object) -> None:
            raise ValueError("out of reach")

    outcome = Worker(WorkerSetup(tmp_path, ("lift",), Unreachable, CAMERAS, stride=1, seed=0)).make_attempt(0)
    assert outcome.failure == "ik"


def test_large_datasets_are_cut_into_files_that_read_back(
    outcomes_and_fast: tuple[list[Outcome], LeRobotDataset], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    outcomes, fast = outcomes_and_fast
    monkeypatch.setattr("lerobot.datasets.feature_utils.DEFAULT_DATA_FILE_SIZE_IN_MB", 1e-3)
    assemble(fast.root.parent, outcomes, FEATURES, FPS, REPO_ID, tmp_path / "cut")
    cut = LeRobotDataset(REPO_ID, root=tmp_path / "cut")
    assert cut.meta.episodes["data/file_index"] == [0, 1, 2]
    assert all(torch.equal(cut[i][keys.STATE], fast[i][keys.STATE]) for i in range(len(fast)))


def test_lerobots_editing_tools_work(fast: LeRobotDataset, tmp_path: Path) -> None:
    edited = delete_episodes(fast, [1], output_dir=tmp_path / "deleted", repo_id="local/deleted")
    assert edited.num_episodes == 2
    key = keys.depth_key(CAMERAS[1])
    assert torch.equal(edited[10][key], fast[20][key])
    parts = split_dataset(fast, {"a": [0], "b": [1, 2]}, output_dir=tmp_path / "split")
    assert [parts[name].num_episodes for name in "ab"] == [1, 2]
    merged = merge_datasets([parts["b"], parts["a"]], "local/merged", output_dir=tmp_path / "merged")
    assert torch.equal(merged[20][key], fast[0][key])
    assert merged[20]["task"] == fast[0]["task"]
