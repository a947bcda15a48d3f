"""From a dataset on disk through LeRobot's own factories, loader and processors into the policy."""

import json
from pathlib import Path
from typing import Any

import pytest
import torch
from lerobot.datasets import LeRobotDataset, LeRobotDatasetMetadata
from lerobot.datasets.factory import resolve_delta_timestamps
from lerobot.policies.factory import make_policy, make_pre_post_processors
from tiny_dataset import write_dataset
from tiny_policy import CAMERAS, STATE_SIZE, TASK, episode
from tiny_scene import SIZE, tiny_network

from lerobot_histmv import keys
from lerobot_histmv.configuration_histmv import HistMVConfig
from lerobot_histmv.modeling_histmv import HistMVPolicy
from lerobot_histmv.windows import look_back

REPO, LENGTHS, PAST_STEPS = "local/tiny", (1, 3, 5), 2


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("datasets") / "tiny"
    write_dataset(folder, REPO, LENGTHS)
    (folder / keys.INSTRUCTIONS_FILE).write_text(json.dumps({TASK: ["lift the red cube"]}))
    return folder


@pytest.fixture(scope="module")
def policy(root: Path) -> HistMVPolicy:
    """Made as ``lerobot-train`` makes it: everything that depends on the data is read from the dataset."""
    torch.manual_seed(0)
    config = HistMVConfig(device="cpu", push_to_hub=False, network=tiny_network(PAST_STEPS))
    made = make_policy(config, ds_meta=LeRobotDatasetMetadata(REPO, root=root)).eval()
    assert isinstance(made, HistMVPolicy)
    return made


@pytest.fixture(scope="module")
def batch(root: Path, policy: HistMVPolicy) -> dict[str, Any]:
    """All windows of the dataset in one batch, after the preprocessor."""
    meta = LeRobotDatasetMetadata(REPO, root=root)
    dataset = LeRobotDataset(REPO, root=root, delta_timestamps=resolve_delta_timestamps(policy.config, meta))
    (loaded,) = torch.utils.data.DataLoader(dataset, batch_size=sum(LENGTHS))
    before, _ = make_pre_post_processors(policy.config, dataset_stats=meta.stats)
    return before(loaded)


def test_policy_reads_cameras_sizes_and_paraphrases_from_the_dataset(policy: HistMVPolicy) -> None:
    assert policy.config.cameras == CAMERAS
    assert policy.config.image_size == SIZE
    assert policy.config.instructions == {TASK: [TASK, "lift the red cube"]}


def test_rows_come_with_their_neighbours_and_every_row_with_a_target(batch: dict[str, Any]) -> None:
    assert batch[keys.STATE].shape == (sum(LENGTHS), 2 * PAST_STEPS + 1, STATE_SIZE)
    assert batch[keys.ACTION].shape == (sum(LENGTHS), 2 * PAST_STEPS + 1, 8)
    padded = batch[f"{keys.STATE}_is_pad"]
    assert padded.equal(batch[f"{keys.ACTION}_is_pad"])
    around = range(-PAST_STEPS, PAST_STEPS + 1)
    outside = [[not 0 <= step + d < length for d in around] for length in LENGTHS for step in range(length)]
    assert padded.tolist() == outside


def test_every_row_of_the_dataset_counts_once(batch: dict[str, Any]) -> None:
    exist = ~batch[f"{keys.STATE}_is_pad"]
    lookback, shares = look_back(exist)
    rows = (batch["index"][:, None] + torch.arange(-PAST_STEPS, PAST_STEPS + 1))[exist][lookback.decided]
    total = torch.zeros(sum(LENGTHS)).index_add(0, rows, shares)
    torch.testing.assert_close(total, torch.ones(sum(LENGTHS)))


def test_whole_dataset_gives_a_finite_loss(policy: HistMVPolicy, batch: dict[str, Any]) -> None:
    loss, log = policy(batch)
    assert loss.isfinite()
    assert 0 < log["position_mm"] < 2000


def test_colours_and_depth_arrive_in_the_policy_s_units(batch: dict[str, Any]) -> None:
    rows = episode(LENGTHS[-1], seed=len(LENGTHS) - 1)
    for camera in CAMERAS:
        rgb, depth = batch[keys.rgb_key(camera)][-1, -1], batch[keys.depth_key(camera)][-1, -1]
        torch.testing.assert_close(rgb, rows[keys.rgb_key(camera)][-1], atol=1 / 255, rtol=0)
        torch.testing.assert_close(depth, rows[keys.depth_key(camera)][-1], atol=1e-3, rtol=0)
