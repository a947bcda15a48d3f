"""History-sensitive transformer: the future changes nothing, padding is inert, the first steps stand alone."""

import pytest
import torch

from lerobot_histmv.model.config import HistoryConfig
from lerobot_histmv.model.history import History, step_index, step_mask

B, T, D, TEXT = 3, 5, 8, 7
GRID = (2, 3)


def history(past_steps: int = T - 1, **changes: object) -> History:
    torch.manual_seed(0)
    config = HistoryConfig(past_steps=past_steps, layers=2, heads=2, **changes)
    return History(config, D, TEXT, GRID).eval()


def steps(t: int = T) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(1)
    fused = torch.randn(B, t, D, *GRID, generator=generator)
    return fused, torch.randn(B, TEXT, generator=generator), torch.ones(B, t, dtype=torch.bool)


def influence(module: History, real: torch.Tensor) -> torch.Tensor:
    """(b, q, p): whether the map of step q of a window depends on step p."""
    fused, text, _ = steps(real.shape[1])
    fused.requires_grad_()
    enriched = module(fused, text, real)
    rows = []
    for q in range(real.shape[1]):
        (gradient,) = torch.autograd.grad(enriched[:, q].square().sum(), fused, retain_graph=True)
        rows.append(gradient.abs().sum(dim=(2, 3, 4)) > 0)
    return torch.stack(rows, dim=1)


def test_steps_depend_on_themselves_and_on_the_real_past_only() -> None:
    real = torch.tensor([[True] * 5, [False] * 2 + [True] * 3, [False] * 4 + [True]])
    found = influence(history(skip_first=False), real)
    causal = torch.ones(T, T, dtype=torch.bool).tril()
    for b, q in torch.cartesian_prod(torch.arange(B), torch.arange(T)).tolist():
        if real[b, q]:
            assert found[b, q].equal(causal[q] & real[b]), (b, q)


def test_first_two_steps_of_an_episode_see_only_the_current_observation() -> None:
    real = torch.tensor([[True] * 5, [False] * 2 + [True] * 3, [False] * 4 + [True]])
    found = influence(history(skip_first=True), real)
    alone = torch.eye(T, dtype=torch.bool)
    assert found[0, :2].equal(alone[:2])
    assert found[0, 2].tolist() == [True, True, True, False, False], "from the third step on all past counts"
    assert found[1, 2:4].equal(alone[2:4])
    assert found[1, 4].tolist() == [False, False, True, True, True]
    assert found[2, 4].equal(alone[4])


@pytest.mark.parametrize("skip_first", [True, False])
def test_padding_is_inert_in_content_and_in_number(skip_first: bool) -> None:
    fused, text, real = steps(3)
    module = history(skip_first=skip_first)
    expected = module(fused, text, real)
    for pads in (1, 2):
        padding = torch.full((B, pads, D, *GRID), 1e3 * pads)
        padded_real = torch.cat([torch.zeros(B, pads, dtype=torch.bool), real], dim=1)
        found = module(torch.cat([padding, fused], dim=1), text, padded_real)
        torch.testing.assert_close(found[:, pads:], expected)


def test_order_of_past_steps_matters() -> None:
    fused, text, real = steps()
    swapped = fused[:, [1, 0, 2, 3, 4]]
    assert not torch.allclose(history()(swapped, text, real)[:, -1], history()(fused, text, real)[:, -1], atol=1e-4)


def test_instruction_reaches_every_step_and_windows_do_not_mix() -> None:
    fused, text, real = steps()
    text.requires_grad_()
    enriched = history()(fused, text, real)
    for q in range(T):
        (gradient,) = torch.autograd.grad(enriched[1, q].square().sum(), text, retain_graph=True)
        assert gradient[1].abs().sum() > 0
        assert gradient[[0, 2]].eq(0).all()


@pytest.mark.parametrize(
    ("real", "numbers"),
    [([0, 0, 1, 1, 1], [0, 0, 0, 1, 2]), ([1, 1, 1, 1, 1], [0, 1, 2, 3, 4]), ([0, 0, 0, 0, 1], [0] * 5)],
)
def test_steps_are_counted_from_the_first_real_one(real: list[int], numbers: list[int]) -> None:
    assert step_index(torch.tensor([real]).bool())[0].tolist() == numbers


@pytest.mark.parametrize("skip_first", [True, False])
def test_no_row_of_the_mask_is_empty(skip_first: bool) -> None:
    """A query without any key would turn attention, and with it the gradient, into NaN."""
    windows = torch.tensor([[i >= pads for i in range(T)] for pads in range(T + 1)])
    assert step_mask(windows, skip_first).any(dim=-1).all()


def test_history_grows_with_one_past_step_up_to_the_configured_number() -> None:
    fused, text, real = steps(2)
    short = history()(fused, text, real)
    assert short.shape == fused.shape
