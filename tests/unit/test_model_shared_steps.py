"""Steps and sentences that several decisions share are encoded once, as if each were encoded alone."""

from dataclasses import replace

import pytest
import torch
from helpers.gradients import assert_same_gradients
from tiny_scene import tiny_net, tiny_observation
from torch import Tensor

from lerobot_histmv.model.config import SemanticsConfig, ViewConfig
from lerobot_histmv.model.decoder import Prediction
from lerobot_histmv.model.history import Lookback
from lerobot_histmv.model.network import Encoding, HistMVNet, Observation
from lerobot_histmv.model.semantics import Semantics
from lerobot_histmv.windows import look_back

CPU = torch.device("cpu")
FUSIONS = ["attention", "mean", "tokens"]
EXIST = torch.tensor([[False] + [True] * 4, [True] * 5, [False, False, True, False, False], [True] * 3 + [False] * 2])
"""Windows of two steps before and after the drawn one: at an episode's start, amid one, all of one, at an end."""


def scene(net: HistMVNet) -> tuple[Observation, Lookback]:
    """Real rows of all windows, each window with its own instruction."""
    seen = tiny_observation(int(EXIST.sum()), 3, net.semantics.text_width)
    own = torch.randn(len(EXIST), net.semantics.text_width, generator=torch.Generator().manual_seed(3))
    return replace(seen, text=own[EXIST.nonzero()[:, 0]]), look_back(EXIST)[0]


def numbers(predicted: Prediction) -> Tensor:
    parts = [predicted.position, predicted.surface, predicted.quaternion, predicted.gripper[:, None]]
    return torch.cat([*parts, predicted.log_heat.exp().flatten(1)], dim=1)


def gradients(net: HistMVNet, values: Tensor) -> dict[str, Tensor]:
    weights = torch.randn(values.shape, generator=torch.Generator().manual_seed(0))
    trained = {name: p for name, p in net.named_parameters() if p.requires_grad}
    found = torch.autograd.grad(
        (values * weights).sum(), list(trained.values()), retain_graph=True, materialize_grads=True
    )
    return dict(zip(trained, found, strict=True))


def decided_alone(net: HistMVNet, seen: Observation, asked: Tensor) -> Tensor:
    """Decisions of the ``asked`` ones of a span's steps, of which nothing else is encoded."""
    encoding = net.encode(seen)
    enriched = net.history(encoding.fused[None], seen.text[:1], torch.ones(1, len(asked), dtype=torch.bool))[0]
    predicted, _ = net.decode_best(encoding, enriched)
    return numbers(predicted)[asked]


@pytest.mark.parametrize("fusion", FUSIONS)
def test_overlapping_spans_decide_and_teach_as_if_each_were_encoded_alone(fusion: str) -> None:
    net = tiny_net(views=ViewConfig(fusion=fusion))
    seen, lookback = scene(net)
    assert lookback.rows[lookback.real].bincount().max() == 3, "a step is in several spans"
    together = numbers(net(seen, lookback, "best")[1])
    spans = zip(lookback.rows, lookback.real, lookback.asked, strict=True)
    alone = torch.cat([decided_alone(net, seen.at(rows[real]), asked[real]) for rows, real, asked in spans])
    torch.testing.assert_close(together, alone, atol=2e-5, rtol=1e-4)
    found, plain = gradients(net, together), gradients(net, alone)
    assert_same_gradients(list(found.values()), list(plain.values()), list(found))


def test_a_sentence_that_is_asked_for_twice_teaches_the_tower_twice() -> None:
    torch.manual_seed(0)
    towers = Semantics(SemanticsConfig(image="none"))
    sentences = ["lift the cube", "press the button", "lift the cube", "lift the cube"]
    shared = towers.text(sentences, CPU)
    alone = torch.cat([towers.text([sentence], CPU) for sentence in sentences])
    torch.testing.assert_close(shared, alone)
    weights = torch.randn(shared.shape, generator=torch.Generator().manual_seed(0))
    names, trained = zip(*((name, p) for name, p in towers.named_parameters() if p.requires_grad), strict=True)
    found, plain = (torch.autograd.grad((vectors * weights).sum(), trained) for vectors in (shared, alone))
    assert_same_gradients(found, plain, names)


def rows_of(encoding: Encoding, steps: list[int]) -> dict[str, Tensor]:
    """The given steps of every field, one by one; skips are those of all views of a step."""
    k = encoding.weights.shape[1]
    levels = {f"skip {i}": level.unflatten(0, (-1, k)) for i, level in enumerate(encoding.skips)}
    fields = {name: values for name, values in vars(encoding).items() if name != "skips"} | levels
    return {name: torch.stack([values[step] for step in steps]) for name, values in fields.items()}


@pytest.mark.parametrize("steps", [[0, 1, 2, 3, 4], [4, 3, 2, 1, 0], [0, 1, 2], [1, 1, 3, 0, 2, 4]])
def test_an_encoding_at_some_steps_is_what_indexing_gives_and_itself_only_at_all_in_order(steps: list[int]) -> None:
    net = tiny_net()
    encoding = net.encode(tiny_observation(5, 3, net.semantics.text_width))
    chosen = encoding.at(torch.tensor(steps))
    assert (chosen is encoding) == (steps == list(range(5)))
    found, expected = rows_of(chosen, list(range(len(steps)))), rows_of(encoding, steps)
    for name, values in expected.items():
        assert found[name].equal(values), name
    taught = {name for name, values in expected.items() if values.requires_grad}
    assert {"fused", "maps", "features", "weights", "skip 0", "skip 3"} <= taught
    values, plain = (torch.cat([each[name].flatten(1) for name in sorted(taught)], dim=1) for each in (found, expected))
    first, second = gradients(net, values), gradients(net, plain)
    assert_same_gradients(list(first.values()), list(second.values()), list(first))
