"""Heat map over a view's cloud: a distribution on valid pixels whose expectation is the position."""

from collections.abc import Sequence
from typing import Any

import pytest
import torch
from torch import Tensor, nn

from lerobot_histmv.model.config import DecoderConfig
from lerobot_histmv.model.decoder import (
    LOCAL_CHANNELS,
    OFFSET_UNIT,
    Decoder,
    Prediction,
    around_peak,
    spatial_log_softmax,
)
from lerobot_histmv.model.rotations import matrix_of

M, Y, X, WIDTH = 3, 32, 48, 8
SKIPS = [4, 5, 5, 5]
MIDDLE = torch.tensor([0.45, -0.1, 0.3])


def logits_and_mask() -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(0)
    return torch.randn(M, Y, X, generator=generator), torch.rand(M, Y, X, generator=generator) < 0.5


def test_heat_map_is_a_distribution_over_valid_pixels() -> None:
    logits, valid = logits_and_mask()
    heat = spatial_log_softmax(logits, valid).exp()
    torch.testing.assert_close(heat.sum(dim=(1, 2)), torch.ones(M))
    assert heat[~valid].eq(0).all()
    assert heat[valid].gt(0).all()


def test_heat_map_keeps_the_order_of_logits_and_ignores_those_of_invalid_pixels() -> None:
    logits, valid = logits_and_mask()
    log_heat = spatial_log_softmax(logits, valid)
    assert log_heat[0][valid[0]].argsort().equal(logits[0][valid[0]].argsort())
    spoiled = torch.where(valid, logits, 1e4)
    torch.testing.assert_close(spatial_log_softmax(spoiled, valid), log_heat)


def test_heat_map_of_a_view_that_sees_nothing_is_finite_and_has_finite_gradients() -> None:
    logits, valid = logits_and_mask()
    valid[1] = False
    logits.requires_grad_()
    log_heat = spatial_log_softmax(logits, valid)
    heat = log_heat.exp()
    torch.testing.assert_close(heat.sum(dim=(1, 2)), torch.ones(M))
    assert log_heat[1].isfinite().all()
    (heat * torch.arange(X)).sum().backward()
    assert logits.grad is not None
    assert logits.grad.isfinite().all()


def test_a_heat_map_torn_between_two_objects_decides_for_the_stronger() -> None:
    rows, columns = torch.meshgrid(torch.arange(Y), torch.arange(X), indexing="ij")
    cloud = 0.01 * torch.stack([columns, rows, torch.zeros(Y, X)]).expand(M, 3, Y, X)
    heat = torch.zeros(M, Y, X)
    heat[:, 7, 5], heat[:, 7, 6], heat[:, 23, 41] = 0.4, 0.2, 0.4 - 1e-3
    kept, share = around_peak(heat, cloud)
    torch.testing.assert_close(share, torch.full((M,), 0.6))
    torch.testing.assert_close(kept.sum(dim=(1, 2)), torch.ones(M))
    assert kept[:, 23, 41].eq(0).all(), "the other object does not pull"
    torch.testing.assert_close(kept[:, 7, 5] / kept[:, 7, 6], torch.full((M,), 2.0))
    again, everything = around_peak(kept, cloud)
    torch.testing.assert_close(again, kept)
    torch.testing.assert_close(everything, torch.ones(M))


def inputs(seed: int = 1) -> dict[str, Any]:
    generator = torch.Generator().manual_seed(seed)
    maps, view = torch.randn(2, M, WIDTH, Y // 16, X // 16, generator=generator)
    skips = [
        torch.randn(M, channels, Y // stride, X // stride, generator=generator)
        for channels, stride in zip(SKIPS, (2, 4, 8, 16), strict=True)
    ]
    cloud = torch.rand(M, 3, Y, X, generator=generator)
    return {
        "maps": maps,
        "view": view,
        "skips": skips,
        "cloud": cloud,
        "valid": torch.rand(M, Y, X, generator=generator) < 0.7,
        "eye": torch.randn(M, 3, generator=generator),
        "tool": matrix_of(nn.functional.normalize(torch.randn(M, 4, generator=generator), dim=1)),
        "opening": torch.rand(M, generator=generator),
    }


def decoder(seed: int = 0) -> Decoder:
    torch.manual_seed(seed)
    return Decoder(WIDTH, SKIPS, DecoderConfig(), MIDDLE)


def decode(module: Decoder, given: dict[str, Any]) -> Prediction:
    return module(**given)


PIXELS = [(5, 3), (19, 29), (29, 47)]
"""Row and column at which each view's heat map gets its peak."""


class Planted(nn.Module):
    """In place of the first decoder: heat map logits that do not depend on what is seen."""

    def __init__(self, logits: Tensor) -> None:
        super().__init__()
        self.logits = logits

    def forward(self, maps: Tensor, skips: list[Tensor], size: tuple[int, int]) -> tuple[Tensor, Tensor]:
        assert self.logits.shape == (len(maps), *size)
        return self.logits, torch.zeros(len(maps), LOCAL_CHANNELS, Y // 4, X // 4)


def plant(logits: Tensor, valid: Tensor, views: Sequence[int], height: float = 100.0) -> None:
    """Raise a peak at the valid pixel of the given views; in all views a higher one where nothing was measured."""
    logits[:, 13, 11], valid[:, 13, 11] = 2 * height, False
    for m in views:
        row, column = PIXELS[m]
        logits[m, row, column], valid[m, row, column] = height, True


def points_under_peaks(cloud: Tensor) -> Tensor:
    return torch.stack([cloud[m, :, row, column] for m, (row, column) in enumerate(PIXELS)])


@pytest.mark.parametrize("training", [True, False])
def test_target_planted_in_the_cloud_is_recovered_exactly(training: bool) -> None:
    given, module = inputs(), decoder().train(training)
    logits, given["valid"] = logits_and_mask()
    plant(logits, given["valid"], range(M))
    module.position = Planted(logits)
    assert given["valid"].sum() > M * Y * X / 3, "many pixels compete"
    assert given["cloud"][0].flatten(1).unique(dim=1).shape == (3, Y * X), "no two points are alike"
    assert decode(module, given).surface.equal(points_under_peaks(given["cloud"]))


def test_acting_recovers_a_target_from_which_the_rest_of_the_heat_pulls_in_training() -> None:
    given, module = inputs(), decoder()
    given["cloud"] = 10 * given["cloud"]  # no two points within the peak's reach
    noise, given["valid"] = logits_and_mask()
    logits = 0.1 * noise
    plant(logits, given["valid"], range(M), height=0.7)
    module.position = Planted(logits)
    target = points_under_peaks(given["cloud"])
    pulled, acting = decode(module.train(), given), decode(module.eval(), given)
    assert acting.surface.equal(target)
    assert acting.certainty.less(0.9).all()
    assert (pulled.surface - target).norm(dim=1).gt(0.1).all()


def test_only_valid_pixel_is_recovered_exactly() -> None:
    given, module = inputs(), decoder()
    given["valid"] = torch.zeros(M, Y, X, dtype=torch.bool)
    for m, (row, column) in enumerate(PIXELS):
        given["valid"][m, row, column] = True
    assert decode(module, given).surface.equal(points_under_peaks(given["cloud"]))


def test_position_is_the_heat_map_s_mean_over_the_cloud_plus_an_offset() -> None:
    given, module = inputs(), decoder()
    found = decode(module, given)
    expected = (found.log_heat.exp()[:, None] * given["cloud"]).sum(dim=(2, 3))
    torch.testing.assert_close(found.surface, expected)
    given["cloud"], given["eye"] = given["cloud"] + 3, given["eye"] + 3
    moved = decode(module, given)
    torch.testing.assert_close(moved.surface, found.surface + 3)
    torch.testing.assert_close(moved.position - moved.surface, found.position - found.surface, atol=1e-5, rtol=0)


def test_depth_number_moves_the_position_along_the_ray_from_the_camera() -> None:
    given, module = inputs(), decoder()
    last = module.pose.dense[-1]
    nn.init.zeros_(last.weight)
    last.bias.data = torch.tensor([0.0] * 16 + [0.2])
    found = decode(module, given)
    ray = (found.surface - given["eye"]) / (found.surface - given["eye"]).norm(dim=1, keepdim=True)
    torch.testing.assert_close(found.position, found.surface + 0.2 * OFFSET_UNIT * ray)


@pytest.mark.parametrize("tool_frame", [True, False])
def test_rotation_turns_with_the_tool_only_in_the_tool_s_frame(tool_frame: bool) -> None:
    given, module = inputs(), Decoder(WIDTH, SKIPS, DecoderConfig(tool_frame=tool_frame), MIDDLE)
    before = decode(module, given).quaternion
    given["tool"] = given["tool"].mT
    assert decode(module, given).quaternion.equal(before) != tool_frame


def test_mixed_precision_rounds_no_action_that_follows_from_the_same_numbers() -> None:
    """Half precision may compute the numbers; what they mean in the tool's frame and along the ray, it may not."""
    given, module = inputs(), decoder()
    numbers = torch.randn(M, 17, generator=torch.Generator().manual_seed(2))
    module.position = Planted(logits_and_mask()[0])
    module.pose.register_forward_hook(lambda *_: numbers)
    expected = decode(module, given)
    with torch.autocast("cpu", torch.bfloat16):
        found = decode(module, given)
    for name, values in vars(expected).items():
        assert vars(found)[name].equal(values), name


def test_heat_map_learns_to_point_at_a_target_on_the_cloud() -> None:
    given, module = inputs(), decoder()
    target = given["cloud"][:, :, 11, 13]
    given["valid"][:, 11, 13] = True
    optimizer = torch.optim.Adam(module.parameters(), lr=0.01)
    errors = []
    for _ in range(30):
        optimizer.zero_grad()
        error = (decode(module, given).surface - target).square().sum()
        error.backward()
        optimizer.step()
        errors.append(error.item())
    assert errors[-1] < 0.2 * errors[0]


def test_prediction_has_unit_quaternions_and_the_view_s_size() -> None:
    found = decode(decoder(), inputs())
    assert found.log_heat.shape == (M, Y, X)
    torch.testing.assert_close(found.quaternion.norm(dim=1), torch.ones(M))
    assert found.gripper.shape == (M,)


def test_weights_of_zero_give_a_finite_quaternion_and_finite_gradients() -> None:
    module = decoder()
    for parameter in module.parameters():
        nn.init.zeros_(parameter)
    found = decode(module, inputs())
    (found.quaternion.sum() + found.position.sum()).backward()
    assert found.quaternion.isfinite().all()
    assert all(p.grad.isfinite().all() for p in module.parameters() if p.grad is not None)


@pytest.mark.parametrize("name", ["maps", "view", "skips"])
def test_decoders_use_history_view_and_every_skip(name: str) -> None:
    given = inputs()
    leaves = given[name] if name == "skips" else [given[name]]
    for leaf in leaves:
        leaf.requires_grad_()
    found = decode(decoder(), given)
    (found.position.square().sum() + found.gripper.sum()).backward()
    assert all(leaf.grad.abs().sum() > 0 for leaf in leaves)


def together(module: Decoder, steps: list[dict[str, Any]], weights: Tensor) -> tuple[Prediction, Tensor]:
    """Decode steps whose M views are the pairs of ``inputs``; also each view's share of the heat."""
    names = ("maps", "view", "cloud", "valid", "eye")
    maps, views, cloud, valid, eyes = (torch.stack([given[name] for given in steps]) for name in names)
    skips = [torch.cat(levels) for levels in zip(*(given["skips"] for given in steps), strict=True)]
    tools, openings = (torch.stack([given[name][0] for given in steps]) for name in ("tool", "opening"))
    return module.together(maps, views, skips, cloud, valid, eyes, tools, openings, weights)


@pytest.mark.parametrize("training", [True, False])
@pytest.mark.parametrize("view", range(M))
def test_target_planted_in_one_of_several_views_is_recovered_exactly(view: int, training: bool) -> None:
    """Also in a view of small weight: a certain view outvotes what the weights expect."""
    module, steps, planted = decoder().train(training), [inputs(1), inputs(2)], [view, (view + 1) % M]
    logits = torch.empty(len(steps), M, Y, X)
    for given, values, at in zip(steps, logits, planted, strict=True):
        noise, given["valid"] = logits_and_mask()
        plant(values.copy_(noise), given["valid"], [at])
    module.position = Planted(logits.flatten(0, 1))
    found, shares = together(module, steps, torch.tensor([[0.7, 0.25, 0.05], [0.25, 0.05, 0.7]]))
    expected = [points_under_peaks(given["cloud"])[at] for given, at in zip(steps, planted, strict=True)]
    assert found.surface.equal(torch.stack(expected))
    assert shares.equal(torch.eye(M)[planted])


def test_one_softmax_over_all_views_has_their_weights_as_prior() -> None:
    given, module = inputs(), decoder()
    valid = given["valid"]
    even, uneven = torch.full((1, M), 1 / M), torch.tensor([[0.7, 0.25, 0.05]])
    before, after = (
        together(module, [given], weights)[0].log_heat.unflatten(1, (M, Y))[0] for weights in (even, uneven)
    )
    ratio = (after - before)[valid].exp() / (uneven / even)[0].repeat_interleave(valid.sum(dim=(1, 2)))
    torch.testing.assert_close(ratio, ratio[:1].expand_as(ratio), atol=0, rtol=1e-3)
    torch.testing.assert_close(after.exp().sum(), torch.tensor(1.0))
