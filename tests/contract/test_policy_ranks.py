"""Several processes learn what one does: the mean of their gradients is that of all their rows in one batch.

True of every way to choose views but "sampled", whose loss standardises over the rows of one process, and of all but
random numbers: augmentation and the draw of points are switched off here, and every instruction has one wording.
"""

from pathlib import Path
from typing import Any

import pytest
import torch
from accelerate import Accelerator
from accelerate.utils import DistributedDataParallelKwargs
from helpers.gradients import assert_same_gradients
from helpers.ranks import in_ranks
from tiny_policy import TASK, episode, stack, tiny_config, tiny_policy, window
from tiny_scene import tiny_network
from torch.distributed.fsdp import fully_shard
from torch.distributed.tensor import DTensor

from lerobot_histmv.model.config import ViewConfig
from lerobot_histmv.modeling_histmv import HistMVPolicy

RANKS = 2
INSTRUCTIONS = {TASK: [TASK], "press the button": ["press the button", "push the knob"]}
"""Two meanings: the second one's wordings give the paraphrase loss something to do."""


def policy_without_chance(choice: str) -> HistMVPolicy:
    """The policy that decodes "all" views together, or in training those that ``choice`` picks."""
    network = tiny_network(views=ViewConfig() if choice == "all" else ViewConfig(decode="one", train_choice=choice))
    policy = tiny_policy(tiny_config(network=network, instructions=INSTRUCTIONS)).train()
    policy.net.points.eval()
    return policy


def batches() -> list[dict[str, Any]]:
    """A batch for each rank: rank 0 gets the long windows, so that the ranks differ in real rows.

    In some noise an activation lies so near to a leaky ReLU's kink that rounding decides its side; not in this.
    """
    long, short = episode(5, seed=5), episode(1, seed=2)
    return [
        stack([window(long, 4), window(long, 3), window(long, 1)]),
        stack([window(short, 0), window(long, 2), window(episode(2, seed=3), 1)]),
    ]


def gradients(policy: torch.nn.Module) -> dict[str, torch.Tensor]:
    found = {}
    for name, parameter in policy.named_parameters():
        if parameter.grad is not None:
            gradient = parameter.grad
            found[name] = gradient.full_tensor() if isinstance(gradient, DTensor) else gradient
    return found


def replicated(rank: int, folder: Path, choice: str) -> None:
    """Two steps as ``lerobot-train`` does them, but strict: the second fails if some parameter took no part before."""
    strict = DistributedDataParallelKwargs(find_unused_parameters=False)
    accelerator = Accelerator(cpu=True, kwargs_handlers=[strict])
    assert accelerator.num_processes == RANKS
    policy = policy_without_chance(choice)
    prepared = accelerator.prepare(policy)
    for _ in range(2):
        policy.zero_grad()
        loss, _ = prepared.forward(batches()[rank])
        accelerator.backward(loss)
    torch.save(gradients(policy), folder / f"{rank}.pt")
    accelerator.end_training()


def sharded(rank: int, folder: Path, choice: str) -> None:
    """One step with the parameters split over the ranks at the layers that the policy names."""
    torch.distributed.init_process_group("gloo")
    mesh = torch.distributed.init_device_mesh("cpu", (RANKS,))
    policy = policy_without_chance(choice)
    units = [module for module in policy.modules() if type(module).__name__ in policy._fsdp_wrap_modules]
    assert {type(unit).__name__ for unit in units} == set(policy._fsdp_wrap_modules)
    for unit in units:
        fully_shard(unit, mesh=mesh)
    fully_shard(policy, mesh=mesh)
    policy(batches()[rank])[0].backward()
    torch.save(gradients(policy), folder / f"{rank}.pt")
    torch.distributed.destroy_process_group()


@pytest.mark.parametrize(
    ("way", "choice"),
    [
        *((replicated, choice) for choice in ("all", "ranked", "expected", "argmax")),
        *((sharded, choice) for choice in ("all", "ranked")),
    ],
)
def test_ranks_give_the_gradients_of_one_big_batch(way: Any, choice: str, tmp_path: Path) -> None:
    in_ranks(RANKS, tmp_path / "log", way, tmp_path, choice)
    policy = policy_without_chance(choice)
    policy(stack(batches()))[0].backward()
    expected = gradients(policy)
    alone = policy_without_chance(choice)
    alone(batches()[0])[0].backward()
    assert any(not torch.allclose(gradient, expected[name]) for name, gradient in gradients(alone).items())
    for rank in range(RANKS):
        found = torch.load(tmp_path / f"{rank}.pt")
        assert found.keys() == expected.keys()
        assert_same_gradients(list(found.values()), [expected[name] for name in found], list(found))
