"""Blocks that all parts share: the context that keeps geometry in full precision."""

from typing import Any

import pytest
import torch
from torch import Tensor

from lerobot_histmv.model.layers import full_precision


class Claimed(Tensor):
    """A tensor that says it lies on a device which need not exist."""

    @staticmethod
    def __new__(cls, device: str) -> "Claimed":
        made: Claimed = Tensor._make_wrapper_subclass(cls, (3,), device=torch.device(device), dtype=torch.float32)
        return made

    @classmethod
    def __torch_dispatch__(cls, operation: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        raise NotImplementedError(operation)


def mixed(device: str) -> bool:
    return torch.is_autocast_enabled(device)


@pytest.mark.parametrize(("own", "other"), [("cpu", "cuda"), ("cuda", "cpu"), ("xpu", "cuda")])
def test_full_precision_ends_mixed_precision_of_the_tensor_s_own_device_alone(own: str, other: str) -> None:
    before = {device: mixed(device) for device in (own, other)}
    try:
        for device in before:
            torch.set_autocast_enabled(device, True)
        with full_precision(Claimed(own)):
            assert (mixed(own), mixed(other)) == (False, True)
        assert mixed(own) and mixed(other), "and only inside"
    finally:
        for device, enabled in before.items():
            torch.set_autocast_enabled(device, enabled)


def test_full_precision_of_tensors_without_a_device_changes_nothing() -> None:
    with torch.autocast("cpu", torch.bfloat16), full_precision(torch.empty(3, device="meta")):
        assert mixed("cpu")
