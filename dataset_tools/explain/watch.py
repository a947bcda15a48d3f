"""What a policy computed while it acted: one record per decision, from hooks on its modules.

The policy runs as it always does. Its modules' inputs and outputs are noted; what it never makes explicit (attention
weights, information shared between views, what it would have done without a past step) is computed from them.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn

from dataset_tools.explain.attention import attention_weights, forgotten, step_shares
from dataset_tools.inspect.cameras import CameraView
from lerobot_histmv.model.decoder import Prediction
from lerobot_histmv.model.history import SelfAttentionBlock
from lerobot_histmv.model.layers import full_precision
from lerobot_histmv.model.network import HistMVNet
from lerobot_histmv.model.view_attention import normalised_mutual_information
from lerobot_histmv.modeling_histmv import HistMVPolicy
from lerobot_histmv.windows import read_window


@dataclass(frozen=True, eq=False)
class Record:
    """One decision of one environment: what was seen, what was made of it, what was decided.

    The t steps of its history are the last ones of the episode, old to new, this one included.

    Attributes:
        views: what each of the k cameras saw, in the policy's order.
        tool: measured tool position [m].
        weights: view weights w, sum to 1.
        certainties: share of each view's heat near its peak.
        chosen: index of the view that acted, the one with the largest product of weight and certainty.
        heat: heat map over every view's pixels, each sums to 1; 0 on pixels without depth.
        targets: where each view alone would have sent the tool [m]; the chosen one's is the action's, before it is
            limited to the workspace.
        information: normalised mutual information between the views, in [0, 1], diagonal 1.
        attention: share of each step in what this step took, per layer of the history transformer; rows sum to 1.
        influence: how far the target would have moved without each past step [m], none for this step itself.
        memory: how far without all of them [m].
        opening: probability with which the gripper shall be open.
        opening_without_past: the same without all past steps.
        action: target position [m], quaternion wxyz, gripper (1 open, 0 closed).
    """

    views: Mapping[str, CameraView]
    tool: Float[np.ndarray, " 3"]
    weights: Float[np.ndarray, " k"]
    certainties: Float[np.ndarray, " k"]
    chosen: int
    heat: Float[np.ndarray, "k y x"]
    targets: Float[np.ndarray, "k 3"]
    information: Float[np.ndarray, "k k"]
    attention: Float[np.ndarray, "layers t"]
    influence: Float[np.ndarray, " past"]
    memory: float
    opening: float
    opening_without_past: float
    action: Float[np.ndarray, " 8"]


@dataclass(frozen=True)
class Call:
    """One call of a module."""

    inputs: tuple[Any, ...]
    output: Any


Calls = dict[str, list[Call]]


@contextmanager
def watched(policy: HistMVPolicy) -> Iterator[list[Record]]:
    """A list to which every ``select_action`` adds its record while this lasts; batches must hold one environment."""
    net, records = policy.net, list[Record]()
    calls: Calls = {}
    modules: dict[str, Iterable[nn.Module]] = {
        "views": [net.view_attention],
        "history": [net.history],
        "layers": net.history.layers,
        "decoder": [net.decoder],
    }
    handles = [
        module.register_forward_hook(partial(_note, calls, name)) for name, group in modules.items() for module in group
    ]
    act: Callable[..., Float[Tensor, "1 8"]] = policy.select_action

    def select_action(batch: dict[str, Any], **options: Any) -> Float[Tensor, "1 8"]:
        calls.clear()
        action = act(batch, **options)
        noted = dict(calls)
        calls.clear()  # what is computed from the noted calls runs the modules again
        records.append(record(policy, batch, action, noted))
        return action

    policy.select_action = select_action  # type: ignore[method-assign]
    try:
        yield records
    finally:
        del policy.select_action
        for handle in handles:
            handle.remove()


def _note(calls: Calls, name: str, _: Any, inputs: tuple[Any, ...], output: Any) -> None:
    calls.setdefault(name, []).append(Call(inputs, output))


@torch.no_grad()
def record(policy: HistMVPolicy, batch: dict[str, Any], action: Float[Tensor, "1 8"], calls: Calls) -> Record:
    """The record of a decision that ``calls`` noted."""
    (views,), (history,), (decoder,) = calls["views"], calls["history"], calls["decoder"]
    maps, weights, predicted = views.inputs[0], views.output, decoder.output
    projection = policy.net.view_attention.get_buffer("projection")  # there, as one view is decoded
    with full_precision(maps):
        information = normalised_mutual_information(maps.float(), projection)
    steps = history.inputs[0].shape[1]
    attention = [
        step_shares(attention_weights(layer, *call.inputs), steps)[0, -1]
        for layer, call in zip(policy.net.history.layers, calls["layers"], strict=True)
        if isinstance(layer, SelfAttentionBlock)
    ]
    past, chosen = range(steps - 1), _best(weights, predicted)
    memory, opening = _without(policy.net, calls, past)
    return Record(
        views=_camera_views(policy, batch),
        tool=_array(read_window(batch, policy.config.cameras).tool[0]),
        weights=_array(weights[0]),
        certainties=_array(predicted.certainty),
        chosen=chosen,
        heat=_array(predicted.log_heat.exp()),
        targets=_array(predicted.position),
        information=_array(information[0]),
        attention=_array(torch.stack(attention)),
        influence=np.array([_without(policy.net, calls, [step])[0] for step in past]),
        memory=memory,
        opening=_opening(predicted, chosen),
        opening_without_past=opening,
        action=_array(action[0]),
    )


def _best(weights: Float[Tensor, "1 k"], predicted: Prediction) -> int:
    return int((weights[0] * predicted.certainty).argmax())


def _opening(predicted: Prediction, view: int) -> float:
    return float(predicted.gripper[view].sigmoid())


def _without(net: HistMVNet, calls: Calls, steps: Sequence[int]) -> tuple[float, float]:
    """How far the target moves [m], and the probability of "open", if the history does not see ``steps`` of its window.

    The cached steps themselves stay as they were encoded: what is hidden is hidden from the history transformer.
    """
    (views,), (history,), (decoder,) = calls["views"], calls["history"], calls["decoder"]
    with forgotten(net.history, steps, history.inputs[0].shape[1]):
        enriched = net.history(*history.inputs)[:, -1]
    predicted = net.decoder(enriched.expand_as(decoder.inputs[0]), *decoder.inputs[1:])
    best = _best(views.output, predicted)
    before = decoder.output.position[_best(views.output, decoder.output)]
    return float((predicted.position[best] - before).norm()), _opening(predicted, best)


def _camera_views(policy: HistMVPolicy, batch: dict[str, Any]) -> dict[str, CameraView]:
    window = read_window(batch, policy.config.cameras)
    return {
        camera: CameraView(
            color=(255 * window.rgb[0, index]).round().byte().permute(1, 2, 0).cpu().numpy(),
            depth=(1000 * window.depth[0, index]).round().cpu().numpy().astype(np.uint16),
            intrinsics=_array(window.intrinsics[0, index]),
            world_from_cam=_array(window.extrinsics[0, index]),
        )
        for index, camera in enumerate(policy.config.cameras)
    }


def _array(values: Tensor) -> np.ndarray:
    return values.detach().float().cpu().numpy()
