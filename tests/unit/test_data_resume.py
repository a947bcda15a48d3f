"""A resumed training reads, on every process and at whatever step it stopped, the rows that it would have read."""

from itertools import islice

import pytest
from accelerate.data_loader import prepare_data_loader
from lerobot.datasets import EpisodeAwareSampler, compute_sampler_state
from lerobot.utils.utils import cycle
from torch.utils.data import DataLoader

from lerobot_histmv.data.resume import ResumedSampler

STARTS, ENDS = [0, 7, 12], [7, 12, 23]
STEPS = 29


def batches(sampler: EpisodeAwareSampler, batch_size: int, processes: int, rank: int) -> list[list[int]]:
    """What one process reads until step ``STEPS``, as ``lerobot-train`` makes its loader."""
    loader = DataLoader(range(ENDS[-1]), batch_size=batch_size, sampler=sampler)  # type: ignore[arg-type]
    prepared = prepare_data_loader(loader, num_processes=processes, process_index=rank)
    return [batch.tolist() for batch in islice(cycle(prepared), STEPS)]


@pytest.mark.parametrize("processes", [1, 2, 3])
@pytest.mark.parametrize("batch_size", [2, 5])
def test_rows_after_a_restart_are_those_of_a_run_without_one(processes: int, batch_size: int) -> None:
    for rank in range(processes):
        straight = batches(EpisodeAwareSampler(STARTS, ENDS, shuffle=True, seed=3), batch_size, processes, rank)
        for stopped in range(1, STEPS - 1):
            sampler = ResumedSampler(STARTS, ENDS, shuffle=True, seed=3, batch_size=batch_size, processes=processes)
            sampler.load_state_dict(compute_sampler_state(stopped, len(sampler), batch_size, processes))
            assert batches(sampler, batch_size, processes, rank)[: STEPS - stopped] == straight[stopped:]


def test_a_loader_that_numbers_epochs_rightly_is_believed() -> None:
    """As later versions of LeRobot may do it."""
    sampler = ResumedSampler(STARTS, ENDS, shuffle=True, seed=3, batch_size=2, processes=1)
    sampler.load_state_dict({"epoch": 5, "start_index": 4})
    plain = EpisodeAwareSampler(STARTS, ENDS, shuffle=True, seed=3)
    for epoch in (5, 6):
        sampler.set_epoch(epoch)
        plain.set_epoch(epoch)
        assert list(sampler) == list(plain)[4 if epoch == 5 else 0 :]
