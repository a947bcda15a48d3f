"""What a policy computed while it acted: one record per decision, from hooks on its modules.

The policy runs as it always does. What goes into its modules and comes out is noted; what it never makes explicit
(attention weights, information shared between views, what each view alone or no past would have led to) is computed
from that.
"""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from dataset_tools.explain.attention import attention_weights, forgotten, step_shares
from dataset_tools.inspect.cameras import CameraView
from lerobot_histmv.model.config import ViewConfig
from lerobot_histmv.model.decoder import Prediction, around_peak
from lerobot_histmv.model.history import SelfAttentionBlock
from lerobot_histmv.model.layers import full_precision
from lerobot_histmv.model.network import Encoding, HistMVNet
from lerobot_histmv.model.view_attention import choose_views, normalised_mutual_information
from lerobot_histmv.modeling_histmv import HistMVPolicy
from lerobot_histmv.past import Past
from lerobot_histmv.windows import read_window


@dataclass(frozen=True)
class Choosing:
    """In words, how a policy chooses the view that acts.

    Args:
        support: what speaks for a view beside its weight.
        score: what the acting view has most of.
    """

    support: str
    score: str

    @classmethod
    def of(cls, views: ViewConfig) -> "Choosing":
        """With one common heat map, the view that holds most of it acts."""
        if views.decode == "all":
            return cls("heat", "share of the heat")
        return cls("certainty", "weight" if views.act == "weight" else "weight x certainty")


@dataclass(frozen=True, eq=False)
class Record:
    """One decision of one environment: what was seen, what was made of it, what was decided.

    The t steps of its history are the last ones of the episode, old to new, this one included.

    Attributes:
        views: what each of the k cameras saw, in the policy's order.
        tool: measured tool position [m].
        choosing: what ``support`` and ``scores`` are.
        weights: view weights w, sum to 1.
        support: with views.decode="one" the share of each view's heat near its peak, with "all" the share of the common
            heat near its peak that lies in each view.
        scores: what the acting view has most of.
        chosen: index of the view that acted.
        heat: heat map of every view by itself, each sums to 1; 0 on pixels without depth.
        targets: where each view alone would have sent the tool [m].
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
    choosing: Choosing
    weights: Float[np.ndarray, " k"]
    support: Float[np.ndarray, " k"]
    scores: Float[np.ndarray, " k"]
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


@dataclass
class Notes:
    """What a decision left behind: inputs of the history transformer and of its layers, the encoding, the outcome."""

    history: tuple[Any, ...] = ()
    layers: list[tuple[Any, ...]] = field(default_factory=list)
    encoding: Encoding | None = None
    enriched: Float[Tensor, "1 d h w"] | None = None
    outcome: tuple[Prediction, Int[Tensor, "1 2"]] | None = None


@contextmanager
def watched(policy: HistMVPolicy) -> Iterator[list[Record]]:
    """A list to which every decision adds its record while this lasts; batches must hold one environment.

    With ``control.rate`` above 0 most calls of ``select_action`` decide nothing.
    """
    net, records, notes = policy.net, list[Record](), Notes()
    decide = policy._decide
    decode_best = net.decode_best

    def note_history(_: Any, inputs: tuple[Any, ...], __: Any) -> None:
        notes.history = inputs

    def note_layer(_: Any, inputs: tuple[Any, ...], __: Any) -> None:
        notes.layers.append(inputs)

    def note_decoding(encoding: Encoding, enriched: Tensor) -> tuple[Prediction, Tensor]:
        notes.encoding, notes.enriched, notes.outcome = encoding, enriched, decode_best(encoding, enriched)
        return notes.outcome

    @contextmanager
    def noted() -> Iterator[None]:
        handles = [net.history.register_forward_hook(note_history)]
        handles += [layer.register_forward_hook(note_layer) for layer in net.history.layers]
        net.decode_best = note_decoding  # type: ignore[method-assign]
        notes.layers = []
        try:
            yield
        finally:
            del net.decode_best
            for handle in handles:
                handle.remove()

    def decide_and_note(batch: dict[str, Any], past: Past, rows: Sequence[int]) -> Float[Tensor, "1 8"]:
        with noted():
            action = decide(batch, past, rows)
        records.append(record(policy, batch, action, notes))
        return action

    policy._decide = decide_and_note  # type: ignore[method-assign]
    try:
        yield records
    finally:
        del policy._decide


@torch.no_grad()
def record(policy: HistMVPolicy, batch: dict[str, Any], action: Float[Tensor, "1 8"], notes: Notes) -> Record:
    """The record of a decision that ``notes`` are of."""
    net, encoding, views = policy.net, notes.encoding, policy.config.network.views
    assert encoding is not None and notes.enriched is not None and notes.outcome is not None
    weights = encoding.weights
    alone = net.decode(encoding, notes.enriched, choose_views(weights, "expected")[0])
    choosing, support = Choosing.of(views), alone.certainty
    if views.decode == "all":
        together = notes.outcome[0].log_heat.exp()
        if net.config.decoder.peak:
            together, _ = around_peak(together, net.heat_cloud(encoding, notes.outcome[1])[0])
        support = together.view_as(alone.log_heat).sum(dim=(-2, -1))
    scores = {"weight": weights[0], "weight x certainty": weights[0] * support}.get(choosing.score, support)
    with full_precision(encoding.maps):
        projection = net.view_attention.get_buffer("projection")  # there, as view attention is on
        information = normalised_mutual_information(encoding.maps.float(), projection)
    steps = notes.history[0].shape[1]
    attention = [
        step_shares(attention_weights(layer, *inputs), steps)[0, -1]
        for layer, inputs in zip(net.history.layers, notes.layers, strict=True)
        if isinstance(layer, SelfAttentionBlock)
    ]
    past = range(steps - 1)
    memory, opening = _without(net, notes, past)
    return Record(
        views=_camera_views(policy, batch),
        tool=_array(read_window(batch, policy.config.cameras).tool[0, -1]),
        choosing=choosing,
        weights=_array(weights[0]),
        support=_array(support),
        scores=_array(scores),
        chosen=int(notes.outcome[1][0, 1]),
        heat=_array(alone.log_heat.exp()),
        targets=_array(alone.position),
        information=_array(information[0]),
        attention=_array(torch.stack(attention)),
        influence=np.array([_without(net, notes, [step])[0] for step in past]),
        memory=memory,
        opening=float(notes.outcome[0].gripper.sigmoid()),
        opening_without_past=opening,
        action=_array(action[0]),
    )


def _without(net: HistMVNet, notes: Notes, steps: Sequence[int]) -> tuple[float, float]:
    """How far the target moves [m], and the probability of "open", if the history does not see ``steps`` of its window.

    The cached steps themselves stay as they were encoded: what is hidden is hidden from the history transformer.
    """
    assert notes.encoding is not None and notes.outcome is not None
    with forgotten(net.history, steps, notes.history[0].shape[1]):
        enriched = net.history(*notes.history)[:, -1]
    predicted, _ = net.decode_best(notes.encoding, enriched)
    return float((predicted.position - notes.outcome[0].position).norm()), float(predicted.gripper.sigmoid())


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
