"""Figures of a tiny seeded policy: loss, gradients and an action, so that no change of the network goes unnoticed.

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


def measure() -> dict[str, Any]:
    """Loss and its terms without chance, gradient norms of one training step per module, and three actions."""
    policy, rows = tiny_policy(seed=7), episode(3, seed=7)
    batch = stack([window(rows, end) for end in range(3)])
    with torch.no_grad():
        loss, log = policy(batch)
    actions = torch.cat([policy.select_action(observation(rows, step)) for step in range(3)])
    torch.manual_seed(7)
    policy.train()(batch)[0].backward()
    norms = {
        name: torch.cat([p.grad.flatten() for p in module.parameters() if p.grad is not None]).norm().item()
        for name, module in policy.net.named_children()
        if any(p.grad is not None for p in module.parameters())
    }
    return {"loss": loss.item(), "log": log, "gradient_norms": norms, "actions": actions.tolist()}


def main() -> None:
    """Write the figures, atomically, and never over others without being told to."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--overwrite", action="store_true", help="replace the stored figures; CHANGELOG.md says why")
    overwrite = parser.parse_args().overwrite
    if GOLDEN.exists() and not overwrite:
        raise SystemExit(f"{GOLDEN} exists; --overwrite replaces it")
    draft = GOLDEN.with_suffix(".draft")
    draft.write_text(json.dumps(measure(), indent=1) + "\n")
    draft.replace(GOLDEN)


if __name__ == "__main__":
    main()
