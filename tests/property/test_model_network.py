"""Laws of the whole network: views have no order, the future no effect, padding no weight, batches no neighbours."""

from dataclasses import replace

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tiny_scene import SEEN, SIZE, cameras_around, noise_images, tiny_net, tiny_observation
from torch.nn.functional import pad

from lerobot_histmv.model.config import DecoderConfig, HistoryConfig, PointsConfig, ViewConfig
from lerobot_histmv.model.decoder import Prediction
from lerobot_histmv.model.history import Lookback
from lerobot_histmv.model.network import Encoding, HistMVNet, Observation
from lerobot_histmv.windows import Window, past_tools

K = 3
FEW = settings(max_examples=5, deadline=None, derandomize=True)


def assert_same(first: Prediction, second: Prediction, rows: slice | torch.Tensor = slice(None)) -> None:
    for name, values in vars(first).items():
        torch.testing.assert_close(
            values[rows], vars(second)[name][rows], atol=2e-5, rtol=1e-4, msg=lambda m, n=name: f"{n}: {m}"
        )


def unrelated(steps: int) -> Lookback:
    """Steps without a past."""
    return Lookback.over(torch.ones(steps, 1, dtype=torch.bool))


def decide(net: HistMVNet, seen: Observation) -> tuple[torch.Tensor, Prediction, torch.Tensor]:
    """View weights, prediction from the best view, and that view, of unrelated steps."""
    with torch.no_grad():
        encoding, predicted, views, _ = net(seen, unrelated(len(seen.depth)), "best")
    return encoding.weights, predicted, views[:, 1]


@pytest.fixture(scope="module", params=["all", "one"])
def net(request: pytest.FixtureRequest) -> HistMVNet:
    return tiny_net(views=ViewConfig(decode=request.param))


@pytest.mark.parametrize("k", [1, 2, 3, 5])
def test_one_network_serves_any_number_of_views(net: HistMVNet, k: int) -> None:
    seen = tiny_observation(2, k, net.semantics.text_width)
    weights, predicted, _ = decide(net, seen)
    torch.testing.assert_close(weights.sum(dim=1), torch.ones(2))
    assert weights.shape == (2, k)
    assert predicted.log_heat.shape == (2, SIZE[0] * (k if net.config.views.decode == "all" else 1), SIZE[1])
    assert all(values.isfinite().all() for values in (predicted.position, predicted.quaternion, predicted.gripper))


def test_the_view_that_acts_has_the_largest_product_of_weight_and_certainty() -> None:
    n, k, net = 7, 3, tiny_net(views=ViewConfig(decode="one"))
    seen = tiny_observation(n, k, net.semantics.text_width)
    with torch.no_grad():
        encoding = net.encode(seen)
        enriched = net.remember(encoding.fused, seen.text, unrelated(n))
        every = net.decode(encoding, enriched, torch.cartesian_prod(torch.arange(n), torch.arange(k)))
        best, views = net.decode_best(encoding, enriched)
    worth = encoding.weights * every.certainty.view(n, k)
    assert views[:, 0].equal(torch.arange(n))
    assert views[:, 1].equal(worth.argmax(dim=1))
    assert_same(best, every.at(torch.arange(n) * k + views[:, 1]))
    assert ((every.certainty > 0) & (every.certainty <= 1 + 1e-6)).all()


def in_order(seen: Observation, order: list[int]) -> Observation:
    return replace(
        seen, **{name: getattr(seen, name)[:, order] for name in ("rgb", "depth", "intrinsics", "extrinsics")}
    )


PIXELS = 5


@pytest.fixture(scope="module", params=["all", "one"])
def all_points(request: pytest.FixtureRequest) -> HistMVNet:
    """Every one of ``PIXELS`` valid pixels per view becomes a point token, so that no draw interferes."""
    return tiny_net(
        views=ViewConfig(decode=request.param),
        points=PointsConfig(samples=SIZE[0] * SIZE[1] * K, centres=(K * PIXELS,), radii=(0.2,), neighbours=3),
    )


@FEW
@given(order=st.permutations(range(K)))
def test_view_order_does_not_matter(all_points: HistMVNet, order: list[int]) -> None:
    """There are no view codes: weights and heat maps are permuted and all else stays."""
    seen = tiny_observation(2, K, all_points.semantics.text_width)
    few = (
        torch.rand(seen.rgb[:, :, 0].shape, generator=torch.Generator().manual_seed(0)).flatten(2).argsort(dim=2)
        < PIXELS
    )
    seen = replace(seen, depth=0.5 * few.unflatten(2, SIZE))
    weights, predicted, view = decide(all_points, seen)
    permuted_weights, permuted_predicted, permuted_view = decide(all_points, in_order(seen, order))
    torch.testing.assert_close(permuted_weights, weights[:, order], atol=1e-5, rtol=0)
    assert torch.tensor(order)[permuted_view].equal(view)
    heat = predicted.log_heat
    if all_points.config.views.decode == "all":
        heat = heat.unflatten(1, (K, -1))[:, order].flatten(1, 2)
    assert_same(permuted_predicted, replace(predicted, log_heat=heat))


def test_view_order_hardly_matters_when_points_are_sampled() -> None:
    """Which points are drawn does depend on the order; what they stand for does not."""
    net = tiny_net(points=PointsConfig(samples=311, centres=(61, 13), radii=(0.1, 0.3), neighbours=5))
    seen = tiny_observation(2, K, net.semantics.text_width)
    weights, _, _ = decide(net, seen)
    permuted, _, _ = decide(net, in_order(seen, [2, 0, 1]))
    torch.testing.assert_close(permuted, weights[:, [2, 0, 1]], atol=0.02, rtol=0)


def test_steps_of_a_batch_do_not_mix(net: HistMVNet) -> None:
    seen = tiny_observation(3, 2, net.semantics.text_width)
    together = decide(net, seen)[1]
    alone = decide(net, Observation(**{name: v[1:2] for name, v in vars(seen).items() if v is not None}))[1]
    for name, values in vars(together).items():
        torch.testing.assert_close(values[1:2], vars(alone)[name], atol=2e-5, rtol=1e-4)


def test_view_without_valid_depth_is_never_chosen_and_its_colours_do_not_matter(net: HistMVNet) -> None:
    seen = tiny_observation(2, K, net.semantics.text_width)
    best = decide(net, seen)[2]
    depth, rgb = seen.depth.clone(), seen.rgb.clone()
    depth[torch.arange(2), best] = 0
    rgb[torch.arange(2), best] = 0.5
    weights, predicted, view = decide(net, replace(seen, depth=depth))
    assert weights[torch.arange(2), best].eq(0).all()
    assert (view != best).all()
    assert_same(decide(net, replace(seen, depth=depth, rgb=rgb))[1], predicted)


@pytest.mark.parametrize("farther", [20.0, -20.0])
def test_a_scene_of_which_nothing_counts_is_decided_from_the_middle_of_the_workspace(
    net: HistMVNet, farther: float
) -> None:
    """All pixels outside of the workspace or without depth: neither far points nor camera positions are targets."""
    seen = tiny_observation(2, K, net.semantics.text_width)
    _, predicted, _ = decide(net, replace(seen, depth=(seen.depth + farther).clamp_min(0)))
    assert predicted.surface.equal(net.workspace.centre.expand(2, 3))
    assert all(values.isfinite().all() for values in (predicted.position, predicted.quaternion, predicted.gripper))


def walked(tools: torch.Tensor) -> dict[str, torch.Tensor]:
    """Tool positions (t, p, 3) up to each of t steps, and their heat."""
    exist = torch.ones(1, len(tools), dtype=torch.bool)
    before, heat = past_tools(tools[None], exist, rows=2 * len(tools) + 1)
    return {"tool": before[0, -len(tools) :], "heat": heat[0, -len(tools) :]}


def window(steps: int, seed: int = 0, k: int = 2) -> Window:
    """One window of ``steps`` real rows."""
    generator = torch.Generator().manual_seed(seed)
    rgb, depth = noise_images(steps, k, generator)
    intrinsics, extrinsics = cameras_around(k)
    return Window(
        real=torch.ones(1, steps, dtype=torch.bool),
        rgb=rgb,
        depth=depth,
        intrinsics=intrinsics.expand(steps, k, 4),
        extrinsics=extrinsics.expand(steps, k, 3, 4),
        **walked(SEEN + 0.2 * torch.randn(steps, 3, generator=generator)),
        turn=torch.nn.functional.normalize(torch.randn(steps, 4, generator=generator), dim=-1),
        opening=torch.rand(steps, generator=generator),
        action=None,
    )


def replay(net: HistMVNet, rows: Window) -> Prediction:
    """Predictions of every real row."""
    text = net.semantics.text(["lift the cube"] * len(rows.real), torch.device("cpu"))
    with torch.no_grad():
        return net(rows.observe(text), Lookback.over(rows.real), "best")[1]


@pytest.fixture(scope="module", params=[True, False], ids=["first two alone", "all history"])
def remembering(request: pytest.FixtureRequest) -> HistMVNet:
    history = HistoryConfig(past_steps=4, layers=2, heads=2, skip_first=request.param)
    return tiny_net(history=history)


@FEW
@given(known=st.integers(1, 4), seed=st.integers(1, 100))
def test_future_steps_change_nothing_in_earlier_decisions(remembering: HistMVNet, known: int, seed: int) -> None:
    rows, other = window(5), window(5, seed)
    changed = {
        name: torch.cat([getattr(rows, name)[:known], getattr(other, name)[known:]]) for name in ("rgb", "depth")
    }
    changed |= walked(torch.cat([rows.tool[:known, -1], other.tool[known:, -1]]))
    expected, found = replay(remembering, rows), replay(remembering, replace(rows, **changed))
    assert_same(found, expected, slice(known))
    assert not torch.allclose(found.position[known:], expected.position[known:], atol=1e-6)


@pytest.mark.parametrize("pads", [1, 2])
def test_padding_is_inert(remembering: HistMVNet, pads: int) -> None:
    rows = window(3)
    padded = replace(rows, real=torch.cat([torch.zeros(1, pads, dtype=torch.bool), rows.real], dim=1))
    assert_same(replay(remembering, padded), replay(remembering, rows))


def test_history_matters_from_the_third_step_on() -> None:
    """The first two decisions equal those without any past except for the drawn tool path; the third does not."""
    alone_first = tiny_net(history=HistoryConfig(past_steps=4, layers=2, heads=2, skip_first=True))
    rows, other = window(3), window(3, seed=7)
    changed = replace(rows, rgb=torch.cat([other.rgb[:1], rows.rgb[1:]]))
    expected, found = replay(alone_first, rows), replay(alone_first, changed)
    assert_same(found, expected, slice(1, 2))
    assert not torch.allclose(found.position[2], expected.position[2], atol=1e-6)


@pytest.mark.parametrize("opening", [True, False])
def test_the_gripper_s_opening_matters_to_its_own_step_alone_and_not_to_where_it_looks(opening: bool) -> None:
    net = tiny_net(past_steps=4, decoder=DecoderConfig(opening=opening))
    rows = window(4)
    other = replace(rows, opening=rows.opening.index_fill(0, torch.tensor(2), 0.5))
    first, second = replay(net, rows), replay(net, other)
    moved = [not one.equal(two) for one, two in zip(first.gripper, second.gripper, strict=True)]
    assert moved == [False, False, opening, False]
    assert first.surface.equal(second.surface)


@pytest.mark.parametrize("tool_frame", [True, False])
def test_the_tool_s_turn_matters_to_its_own_step_s_rotation_alone(tool_frame: bool) -> None:
    net = tiny_net(past_steps=4, decoder=DecoderConfig(tool_frame=tool_frame))
    rows = window(4)
    other = replace(rows, turn=rows.turn.index_copy(0, torch.tensor([2]), torch.eye(4)[:1]))
    first, second = replay(net, rows), replay(net, other)
    turned = [not one.equal(two) for one, two in zip(first.quaternion, second.quaternion, strict=True)]
    assert turned == [False, False, tool_frame, False]
    assert_same(replace(second, quaternion=first.quaternion), first)


def test_without_memory_only_the_rows_asked_for_are_encoded(monkeypatch: pytest.MonkeyPatch) -> None:
    net, rows = tiny_net(history=HistoryConfig(enabled=False, layers=2, heads=2)), window(4)
    seen = rows.observe(net.semantics.text(["lift the cube"], torch.device("cpu")))
    expected, encode, encoded = replay(net, rows), net.encode, []

    def count(steps: Observation) -> Encoding:
        encoded.append(len(steps.depth))
        return encode(steps)

    monkeypatch.setattr(net, "encode", count)
    with torch.no_grad():
        found = net(seen, Lookback.over(rows.real).newest(), "best")[1]
    assert encoded == [1]
    assert_same(found, expected.at(torch.tensor([3])))


def test_windows_of_different_length_do_not_mix(remembering: HistMVNet) -> None:
    long, short = window(5), window(2, seed=3)
    real = torch.cat([long.real, torch.tensor([[False] * 3 + [True] * 2])])
    room = long.tool.shape[1] - short.tool.shape[1]
    short = replace(short, tool=pad(short.tool, (0, 0, room, 0)), heat=pad(short.heat, (room, 0)))
    names = ("rgb", "depth", "intrinsics", "extrinsics", "tool", "heat", "turn", "opening")
    both = replace(long, real=real, **{n: torch.cat([getattr(long, n), getattr(short, n)]) for n in names})
    found = replay(remembering, both)
    for rows, expected in ((slice(5), replay(remembering, long)), (slice(5, 7), replay(remembering, short))):
        torch.testing.assert_close(found.position[rows], expected.position, atol=2e-5, rtol=0)
