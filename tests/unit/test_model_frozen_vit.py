"""Frozen Vision Transformers: the vectors of open_clip's own forward pass, from fewer operations."""

import copy
import pickle
from typing import Any

import pytest
import torch
from open_clip.transformer import QuickGELU, VisionTransformer

from lerobot_histmv.model import frozen_vit
from lerobot_histmv.model.frozen_vit import FrozenBlocks, quicken

SIZE, PATCH, WIDTH, LAYERS, HEADS, OUT = 35, 7, 26, 3, 2, 13
TOKENS = 1 + (SIZE // PATCH) ** 2


def tower(**changes: Any) -> VisionTransformer:
    torch.manual_seed(0)
    settings: dict[str, Any] = {"width": WIDTH, "layers": LAYERS, "heads": HEADS, "output_dim": OUT} | changes
    made = VisionTransformer(image_size=SIZE, patch_size=PATCH, mlp_ratio=3, **settings)
    for parameter in made.parameters():  # biases and scales start at 0 and 1, where mistakes do not show
        parameter.data.add_(torch.randn(parameter.shape), alpha=0.3)
    return made.eval().requires_grad_(False)


def quickened(made: VisionTransformer) -> VisionTransformer:
    changed = copy.deepcopy(made)
    quicken(changed)
    assert isinstance(changed.transformer, FrozenBlocks)
    return changed


def images(n: int = 3) -> torch.Tensor:
    return torch.randn(n, 3, SIZE, SIZE, generator=torch.Generator().manual_seed(n))


@pytest.mark.parametrize("arranged", [True, False])
@pytest.mark.parametrize("n", [1, 3, 17])
@pytest.mark.parametrize(
    "changes", [{}, {"act_layer": QuickGELU}, {"ls_init_value": 0.5}, {"final_ln_after_pool": True}]
)
def test_vectors_are_those_of_the_plain_forward_pass(
    changes: dict[str, Any], n: int, arranged: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    if not arranged:
        monkeypatch.setattr(frozen_vit, "can_arrange", lambda weight: False)
    plain = tower(**changes)
    torch.testing.assert_close(quickened(plain)(images(n)), plain(images(n)), rtol=1e-4, atol=1e-5)


def test_weights_are_rearranged_only_where_a_processor_has_the_products_for_it() -> None:
    weight = torch.randn(5, 7)
    assert frozen_vit.can_arrange(weight) == hasattr(torch.ops.mkldnn, "_linear_pointwise")
    assert not frozen_vit.can_arrange(weight.bfloat16())
    assert not frozen_vit.can_arrange(weight.to("meta"))


def test_nothing_but_the_class_token_leaves_the_last_block() -> None:
    made, rows = quickened(tower()), []
    for block in made.transformer.resblocks:
        block.ln_2.register_forward_hook(lambda _, inputs, __: rows.append(tuple(inputs[0].shape)))
    made(images())
    assert rows == [(3, TOKENS, WIDTH)] * (LAYERS - 1) + [(3, 1, WIDTH)]


def test_parameters_keep_their_names_and_values() -> None:
    plain = tower()
    before, after = plain.state_dict(), quickened(plain).state_dict()
    assert list(before) == list(after)
    assert all(before[name].equal(after[name]) for name in before)


def test_precision_may_change_afterwards_and_copies_agree() -> None:
    plain = tower()
    changed = quickened(plain)
    whole = changed(images())
    copies = copy.deepcopy(changed), pickle.loads(pickle.dumps(changed))
    assert all(other(images()).equal(whole) for other in copies)
    rounded = changed.to(torch.bfloat16)(images().bfloat16())
    torch.testing.assert_close(rounded, plain.to(torch.bfloat16)(images().bfloat16()), rtol=0.05, atol=0.1)
    assert copies[0].to("meta")(images().to("meta")).shape == (3, OUT)


def test_autocast_on_a_cpu_rounds_only_how_patches_are_embedded_and_the_vector() -> None:
    changed = quickened(tower())
    tokens = torch.randn(3, TOKENS, WIDTH)
    expected, vectors = changed.transformer(tokens), changed(images())
    with torch.autocast("cpu", torch.bfloat16):
        assert changed.transformer(tokens).equal(expected)
        rounded = changed(images())
    assert rounded.dtype == torch.bfloat16
    torch.testing.assert_close(rounded.float(), vectors, rtol=0.05, atol=0.1)


@pytest.mark.parametrize(
    "changes",
    [
        {"pool_type": "avg"},
        {"attentional_pool": True, "attn_pooler_heads": 1},
        {"qk_norm": True, "block_type": "custom"},
    ],
)
def test_other_towers_are_left_alone(changes: dict[str, Any]) -> None:
    made = tower(**changes)
    before = made(images())
    quicken(made)
    assert not isinstance(made.transformer, FrozenBlocks)
    assert made(images()).equal(before)
