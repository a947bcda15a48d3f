"""Policies of every way to choose a view, records of their decisions, and records of which every number is known."""

from collections.abc import Sequence

import numpy as np
import torch
from tiny_policy import episode, observation, tiny_config, tiny_policy
from tiny_scene import SEEN, SIZE, cameras_around, tiny_network

from dataset_tools.explain.watch import Choosing, Record, watched
from dataset_tools.inspect.cameras import CameraView
from lerobot_histmv.model.config import ViewConfig
from lerobot_histmv.modeling_histmv import HistMVPolicy

STEPS = 7
CHOOSING = {
    "share of the heat": ViewConfig(),
    "weight x certainty": ViewConfig(decode="one"),
    "weight": ViewConfig(decode="one", act="weight"),
}


def policy_choosing(by: str) -> HistMVPolicy:
    """A policy that remembers a whole episode and chooses the acting view in one of the ways."""
    return tiny_policy(tiny_config(network=tiny_network(past_steps=STEPS - 1, views=CHOOSING[by])))


def act(policy: HistMVPolicy) -> tuple[torch.Tensor, list[Record]]:
    """Actions of one episode, and the records of them."""
    rows = episode(STEPS)
    policy.reset()
    with watched(policy) as records:
        actions = torch.cat([policy.select_action(observation(rows, step)) for step in range(STEPS)])
    return actions, records


def made_up(chosen: Sequence[int], cameras: Sequence[str] = ("front", "side", "wrist")) -> list[Record]:
    """Decisions in which the views ``chosen`` acted; no two numbers of a kind are alike, each view has its own grey."""
    k, chance = len(cameras), np.random.default_rng(5)
    intrinsics, extrinsics = (values.numpy() for values in cameras_around(k))
    views = {
        name: CameraView(np.full((*SIZE, 3), 60 + 40 * index, np.uint8), None, intrinsics[index], extrinsics[index])
        for index, name in enumerate(cameras)
    }
    records = []
    for step, view in enumerate(chosen):
        scores = chance.permutation(np.linspace(0.1, 0.6, k))
        scores[[view, scores.argmax()]] = scores[[scores.argmax(), view]]
        influence = 0.01 * (1 + chance.permutation(step))
        records.append(
            Record(
                views=views,
                tool=SEEN.numpy(),
                choosing=Choosing.of(ViewConfig()),
                weights=chance.dirichlet(np.ones(k)),
                support=chance.dirichlet(np.ones(k)),
                scores=scores,
                chosen=view,
                heat=np.zeros((k, *SIZE), np.float32),
                targets=SEEN.numpy() + chance.uniform(-0.1, 0.1, (k, 3)),
                information=np.eye(k),
                attention=chance.dirichlet(np.ones(step + 1), size=2),
                influence=influence,
                memory=0.37 + 0.01 * step,
                opening=0.9,
                opening_without_past=0.2,
                action=np.array([*SEEN.numpy() + chance.uniform(-0.03, 0.03, 3), 1, 0, 0, 0, 1]),
            )
        )
    return records
