"""Laws of the switches: what is off has no effect; views that share one softmax have no order and may repeat."""

from dataclasses import replace

import pytest
import torch
from test_model_network import assert_same, decide, in_order, replay, walked, window
from tiny_scene import SIZE, tiny_net, tiny_observation

from lerobot_histmv.model.config import (
    DecoderConfig,
    HistoryConfig,
    PointsConfig,
    SemanticsConfig,
    TextureConfig,
    ViewConfig,
)
from lerobot_histmv.model.network import HistMVNet, Observation

N = 2
TINY = {"widths": (4, 4, 8, 8), "neck": 4}
NO_POINTS = PointsConfig(enabled=False)
"""Points are drawn from all views, which would let the order of views in."""
TOGETHER = {
    "attention": ViewConfig(decode="all"),
    "mean": ViewConfig(fusion="mean", decode="all"),
    "tokens": ViewConfig(fusion="tokens", decode="all"),
}
"""All ways of fusing views whose pixels share one softmax."""
COLOURS = {
    "panet only": {"semantics": SemanticsConfig(image="none")},
    "clip only": {"texture": TextureConfig(encoder="none", **TINY)},
    "convolutions only": {
        "texture": TextureConfig(encoder="backbone", **TINY),
        "semantics": SemanticsConfig(image="none"),
    },
}
"""What is made of the colours."""
VARIANTS = (
    {f"all pixels, {name}": {"views": views} for name, views in TOGETHER.items()}
    | COLOURS
    | {
        "peer": COLOURS["convolutions only"] | {"views": TOGETHER["tokens"], "points": NO_POINTS},
        "as printed": {
            "decoder": DecoderConfig(ray=False, local=False, peak=False),
            "views": ViewConfig(decode="one", act="weight"),
        },
        "no history": {"history": HistoryConfig(enabled=False, layers=2, heads=2)},
    }
)


def scene(net: HistMVNet, k: int = 3) -> Observation:
    return tiny_observation(N, k, net.semantics.text_width)


@pytest.mark.parametrize("k", [1, 2, 3, 5])
@pytest.mark.parametrize("variant", VARIANTS)
def test_every_variant_serves_any_number_of_views_with_a_heat_map_that_sums_to_one(variant: str, k: int) -> None:
    net = tiny_net(**VARIANTS[variant])
    seen = scene(net, k)
    weights, predicted, _ = decide(net, seen)
    torch.testing.assert_close(weights.sum(dim=1), torch.ones(N))
    heat, together = predicted.log_heat.exp(), net.config.views.decode == "all"
    assert heat.shape == (N, SIZE[0] * (k if together else 1), SIZE[1])
    torch.testing.assert_close(heat.sum(dim=(1, 2)), torch.ones(N))
    if together:
        assert heat[seen.depth.flatten(1, 2) == 0].eq(0).all()
        assert heat.unflatten(1, (k, -1)).sum(dim=(2, 3)).gt(0).all(), "every view has its share"
    assert all(values.isfinite().all() for values in (predicted.position, predicted.quaternion, predicted.gripper))


@pytest.mark.parametrize("fusion", TOGETHER)
def test_order_of_views_that_share_a_softmax_does_not_matter(fusion: str) -> None:
    net, order = tiny_net(views=TOGETHER[fusion], points=NO_POINTS), [2, 0, 1]
    seen = scene(net)
    weights, predicted, view = decide(net, seen)
    other_weights, other, other_view = decide(net, in_order(seen, order))
    torch.testing.assert_close(other_weights, weights[:, order], atol=1e-5, rtol=0)
    assert torch.tensor(order)[other_view].equal(view)
    heat = predicted.log_heat.unflatten(1, (3, -1))[:, order].flatten(1, 2)
    assert_same(replace(other, log_heat=heat), replace(predicted, log_heat=heat))
    torch.testing.assert_close(other.log_heat.exp(), heat.exp(), atol=1e-5, rtol=1e-3)


@pytest.mark.parametrize("fusion", ["mean", "tokens"])
def test_a_view_that_is_shown_twice_changes_nothing_but_its_share(fusion: str) -> None:
    net = tiny_net(views=TOGETHER[fusion], points=NO_POINTS)
    once = in_order(scene(net), [0, 2])
    twice = in_order(scene(net), [0, 2, 0, 2])
    expected, found = decide(net, once)[1], decide(net, twice)[1]
    heat = found.log_heat.exp().unflatten(1, (2, -1)).sum(dim=1)
    torch.testing.assert_close(heat, expected.log_heat.exp(), atol=1e-5, rtol=1e-3)
    assert_same(replace(found, log_heat=heat), replace(expected, log_heat=heat))


def same_weights(net: HistMVNet, **changes: object) -> HistMVNet:
    """Another network with all the weights of ``net`` that it has a place for; none of its own are left."""
    other = tiny_net(seed=1, **changes)
    assert other.load_state_dict(net.state_dict(), strict=False).missing_keys == []
    return other


@pytest.mark.parametrize("fusion", TOGETHER)
def test_all_ways_of_fusing_and_decoding_agree_on_a_single_view(fusion: str) -> None:
    net = tiny_net()
    expected = decide(net, scene(net, k=1))[1]
    assert_same(decide(same_weights(net, views=TOGETHER[fusion]), scene(net, k=1))[1], expected)


def test_one_softmax_over_all_views_is_that_of_the_only_view_that_shows_anything() -> None:
    net = tiny_net(points=NO_POINTS, views=ViewConfig(decode="one"))
    seen = scene(net)
    seen = replace(seen, depth=seen.depth * torch.tensor([0.0, 1.0, 0.0])[:, None, None])
    together = same_weights(net, points=NO_POINTS, views=TOGETHER["attention"])
    _, expected, view = decide(net, seen)
    _, found, with_most_heat = decide(together, seen)
    assert view.tolist() == with_most_heat.tolist() == [1, 1]
    heat = found.log_heat.unflatten(1, (3, -1))[:, 1]
    assert_same(replace(found, log_heat=heat), expected)


def test_fused_map_without_attention_is_the_mean_of_the_views_that_show_something() -> None:
    net = tiny_net(views=TOGETHER["mean"])
    seen = scene(net)
    seen.depth[0, 1] = 0
    encoding = net.encode(seen)
    torch.testing.assert_close(encoding.weights, torch.tensor([[0.5, 0, 0.5], [1 / 3] * 3]))
    torch.testing.assert_close(encoding.fused[0], encoding.maps[0, [0, 2]].mean(dim=0))
    torch.testing.assert_close(encoding.fused[1], encoding.maps[1].mean(dim=0))
    assert list(net.view_attention.parameters()) == []


def test_tokens_of_every_view_are_kept_but_for_one_that_shows_nothing() -> None:
    net = tiny_net(views=TOGETHER["tokens"])
    seen = scene(net)
    seen.depth[0, 1] = 0
    encoding = net.encode(seen)
    stacked = encoding.fused.unflatten(2, (3, SIZE[0] // 16)).transpose(1, 2)
    assert stacked[1].equal(encoding.maps[1])
    assert stacked[0, [0, 2]].equal(encoding.maps[0, [0, 2]])
    assert stacked[0, 1].eq(0).all()


def test_the_view_of_largest_weight_acts_where_certainty_is_not_asked() -> None:
    net = tiny_net(views=ViewConfig(decode="one", act="weight"))
    weights, _, view = decide(net, tiny_observation(7, 3, net.semantics.text_width))
    assert view.equal(weights.argmax(dim=1))


@pytest.mark.parametrize("variant", ["no history", "history", "peer"])
def test_past_steps_change_decisions_exactly_if_history_is_on(variant: str) -> None:
    """Neither past images and tool positions nor their number reach a decision without history."""
    on = {"history": HistoryConfig(past_steps=4, layers=2, heads=2, skip_first=False)}
    off = {"history": HistoryConfig(enabled=False, past_steps=4, layers=2, heads=2, skip_first=False)}
    net = tiny_net(**(VARIANTS["peer"] if variant == "peer" else {}), **(off if variant == "no history" else on))
    rows, other = window(4), window(4, seed=7)
    images = {n: torch.cat([getattr(other, n)[:3], getattr(rows, n)[3:]]) for n in ("rgb", "depth")}
    changed = replace(rows, **images, **walked(torch.cat([other.tool[:3, -1], rows.tool[3:, -1]])))
    last = {n: getattr(rows, n)[3:] for n in ("rgb", "depth", "intrinsics", "extrinsics", "turn", "opening")}
    alone = replace(rows, real=torch.ones(1, 1, dtype=torch.bool), **last, **walked(rows.tool[3:, -1]))
    expected = replay(net, rows).at(torch.tensor([3]))
    for past in (replay(net, changed).at(torch.tensor([3])), replay(net, alone)):
        if variant == "no history":
            assert_same(past, expected)
        else:
            assert not torch.allclose(past.position, expected.position, atol=1e-6)


def clip_vectors(net: HistMVNet, seed: int) -> torch.Tensor:
    return torch.randn(N, 3, net.semantics.image_width, generator=torch.Generator().manual_seed(seed))


@pytest.mark.parametrize("encoder", ["none", "panet"])
def test_colours_reach_the_decision_through_clip_alone_exactly_if_there_is_no_texture(encoder: str) -> None:
    net = tiny_net(texture=TextureConfig(encoder=encoder, **TINY), points=NO_POINTS)
    seen = replace(scene(net), clip=clip_vectors(net, 1))
    expected = decide(net, seen)[1].position
    other_colours = decide(net, replace(seen, rgb=1 - seen.rgb))[1].position
    assert other_colours.equal(expected) == (encoder == "none")
    assert not decide(net, replace(seen, clip=clip_vectors(net, 2)))[1].position.equal(expected)


def test_without_global_vectors_there_is_no_image_tower() -> None:
    names = set(tiny_net(semantics=SemanticsConfig(image="none")).state_dict())
    assert not any("visual" in name or name.startswith("rgba.semantic") for name in names)
    assert any("clip.transformer" in name for name in names), "instructions still need theirs"
