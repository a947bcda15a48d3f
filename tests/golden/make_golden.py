"""Figures of tiny seeded policies: loss, gradients and actions, so that no change of the network goes unnoticed.

``python tests/golden/make_golden.py --overwrite`` writes them anew; CHANGELOG.md then says why they changed.
"""

import argparse
import json
import sys
from pathlib import Path
from typing import Any

import torch

sys.path.insert(0, str(Path(__file__).parents[1]))

from tiny_policy import episode, observation, stack, tiny_policy, window

GOLDEN = Path(__file__).with_name("tiny_policy.json")
SEEDS = (7, 17)
"""The first policy keeps the gripper open, the second closes it."""


def gradient_figures(module: torch.nn.Module) -> list[float]:
    """Norm of a module's gradient, and its shares of that along three fixed directions: signs and order matter."""
    gradients = [p.grad.flatten() for p in module.parameters() if p.grad is not None]
    if not gradients:
        return []
    gradient = torch.cat(gradients)
    signs = torch.randint(2, (3, len(gradient)), generator=torch.Generator().manual_seed(0)) * 2.0 - 1
    return [gradient.norm().item(), *(signs @ gradient / gradient.norm()).tolist()]


def measure(seed: int) -> dict[str, Any]:
    """Loss and its terms without chance, gradients of one training step per module, and three actions."""
    policy, rows = tiny_policy(seed=seed), episode(3, seed=seed)
    batch = stack([window(rows, end) for end in range(3)])
    with torch.no_grad():
        loss, log = policy(batch)
    actions = torch.cat([policy.select_action(observation(rows, step)) for step in range(3)])
    torch.manual_seed(seed)
    policy.train()(batch)[0].backward()
    gradients = {name: gradient_figures(module) for name, module in policy.net.named_children()}
    return {"loss": loss.item(), "log": log, "gradients": gradients, "actions": actions.tolist()}


def main() -> None:
    """Write the figures, atomically, and never over others without being told to."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--overwrite", action="store_true", help="replace the stored figures; CHANGELOG.md says why")
    overwrite = parser.parse_args().overwrite
    if GOLDEN.exists() and not overwrite:
        raise SystemExit(f"{GOLDEN} exists; --overwrite replaces it")
    draft = GOLDEN.with_suffix(".draft")
    draft.write_text(json.dumps({str(seed): measure(seed) for seed in SEEDS}, indent=1) + "\n")
    draft.replace(GOLDEN)


if __name__ == "__main__":
    main()
