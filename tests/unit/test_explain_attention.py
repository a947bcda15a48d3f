"""Laws of the attention that is computed again: with it a layer gives what it gave; it sums to 1 and never looks ahead;
a forgotten step has no influence on any other.
"""

import pytest
import torch
from einops import rearrange

from dataset_tools.explain.attention import attention_weights, forgotten, step_shares
from lerobot_histmv.model.config import HistoryConfig
from lerobot_histmv.model.history import History, SelfAttentionBlock, step_mask

B, T, H, W, D, HEADS, TEXT = 2, 5, 2, 3, 14, 7, 11


@pytest.fixture
def history() -> History:
    torch.manual_seed(0)
    return History(HistoryConfig(past_steps=T - 1, layers=2, heads=HEADS), D, TEXT, (H, W)).eval()


def random_mask(length: int) -> torch.Tensor:
    """Each token sees itself and a random half of the others."""
    chance = torch.rand(B, 1, length, length, generator=torch.Generator().manual_seed(1)) < 0.5
    return chance | torch.eye(length, dtype=torch.bool)


def test_a_layer_with_these_weights_gives_what_the_layer_gave() -> None:
    torch.manual_seed(0)
    layer, tokens, mask = SelfAttentionBlock(D, HEADS, 0.0).eval(), torch.randn(B, 13, D), random_mask(13)
    weights = attention_weights(layer, tokens, mask)
    _, _, values = rearrange(
        layer.project_in(layer.attention_norm(tokens)), "b l (three g e) -> three b g l e", three=3, g=HEADS
    )
    taken = tokens + layer.project_out(rearrange(weights @ values, "b g l e -> b l (g e)"))
    torch.testing.assert_close(taken + layer.mix(layer.mix_norm(taken)), layer(tokens, mask))


def test_shares_of_steps_sum_to_one_and_are_causal() -> None:
    torch.manual_seed(0)
    layer, tokens = SelfAttentionBlock(D, HEADS, 0.0), torch.randn(B, T * H * W, D)
    mask = step_mask(torch.ones(B, T, dtype=torch.bool), skip_first=True)
    mask = mask.repeat_interleave(H * W, dim=1).repeat_interleave(H * W, dim=2)[:, None]
    shares = step_shares(attention_weights(layer, tokens, mask), T)
    torch.testing.assert_close(shares.sum(dim=-1), torch.ones(B, T))
    assert shares.triu(1).eq(0).all()
    torch.testing.assert_close(shares[:, :2, :2], torch.eye(2).expand(B, 2, 2))
    assert (shares.diagonal(dim1=1, dim2=2)[:, 2:] < 1).all()


@pytest.mark.parametrize("gone", [[2], [0, 3]])
def test_a_forgotten_step_has_no_influence_on_others(history: History, gone: list[int]) -> None:
    fused, text, real = torch.randn(B, T, D, H, W), torch.randn(B, TEXT), torch.ones(B, T, dtype=torch.bool)
    other = fused.clone()
    other[:, gone] = torch.randn(B, len(gone), D, H, W)
    kept = [step for step in range(T) if step not in gone]
    with torch.no_grad():
        with forgotten(history, gone, T):
            first, second = history(fused, text, real), history(other, text, real)
        assert not torch.allclose(history(fused, text, real)[:, -1], history(other, text, real)[:, -1], atol=1e-4)
        torch.testing.assert_close(first[:, kept], second[:, kept])
        with forgotten(history, [], T):
            torch.testing.assert_close(history(fused, text, real), history(fused, text, real))
    assert not any(layer._forward_pre_hooks for layer in history.layers)
