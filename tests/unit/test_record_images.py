"""Encoded images hold the same pixels; their statistics are those of the pixels."""

import io

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from dataset_tools.images import encode_depth, encode_rgb, image_statistics

SHAPE = (13, 17)


def test_rgb_survives_encoding() -> None:
    image = np.random.default_rng(0).integers(0, 256, (*SHAPE, 3), np.uint8)
    assert np.array_equal(np.asarray(Image.open(io.BytesIO(encode_rgb(image)))), image)


def test_depth_survives_encoding_as_sixteen_bits() -> None:
    depth = np.random.default_rng(0).integers(0, 65536, (*SHAPE, 1), np.uint16)
    decoded = Image.open(io.BytesIO(encode_depth(depth)))
    assert decoded.mode == "I;16"
    assert np.array_equal(np.asarray(decoded), depth[..., 0])


def test_statistics_of_depth_worked_by_hand() -> None:
    depth = np.array([0, 10, 10, 20], np.uint16).reshape(1, 2, 2, 1)
    found = {name: value.item() for name, value in image_statistics(depth).items()}
    assert (found["min"], found["max"], found["mean"], found["count"]) == (0, 20, 10, 1)
    assert found["std"] == pytest.approx(np.sqrt(50))
    assert 10 <= found["q50"] <= 10 + 20 / 5000


def test_colours_are_scaled_to_one_and_kept_apart() -> None:
    image = np.zeros((3, *SHAPE, 3), np.uint8)
    image[..., 1], image[..., 2] = 51, 255
    statistics = image_statistics(image)
    for name in ("min", "max", "mean", "q01", "q50", "q99"):
        assert statistics[name].shape == (3, 1, 1)
        assert statistics[name].ravel() == pytest.approx([0, 0.2, 1]), name


@given(st.integers(0, 2**32), st.integers(1, 140), st.integers(1, 65535))
def test_quantiles_are_ordered_and_mean_is_exact(seed: int, frames: int, top: int) -> None:
    depth = np.random.default_rng(seed).integers(0, top + 1, (frames, 3, 5, 1), np.uint16)
    found = image_statistics(depth)
    order = ["min", "q01", "q10", "q50", "q90", "q99", "max"]
    values = [found[name].item() for name in order]
    assert np.all(np.diff(values) >= -1e-2)
    assert found["count"].item() <= frames
    if frames <= 100:
        assert found["mean"].item() == pytest.approx(depth.mean())
        assert found["std"].item() == pytest.approx(depth.std(), abs=1e-6)
