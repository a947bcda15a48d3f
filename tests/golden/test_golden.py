"""The tiny seeded policy gives the figures that ``make_golden.py`` stored."""

import json
from typing import Any

import pytest
from make_golden import GOLDEN, measure


@pytest.fixture(scope="module")
def stored() -> dict[str, Any]:
    figures: dict[str, Any] = json.loads(GOLDEN.read_text())
    return figures


@pytest.fixture(scope="module")
def measured(stored: dict[str, Any]) -> dict[str, Any]:
    return measure()


@pytest.mark.parametrize(("figure", "tolerance"), [("loss", 1e-3), ("log", 2e-3), ("gradient_norms", 2e-2)])
def test_figures_are_those_stored(
    stored: dict[str, Any], measured: dict[str, Any], figure: str, tolerance: float
) -> None:
    assert measured[figure] == pytest.approx(stored[figure], rel=tolerance, abs=1e-6)


def test_actions_are_those_stored(stored: dict[str, Any], measured: dict[str, Any]) -> None:
    for found, expected in zip(measured["actions"], stored["actions"], strict=True):
        assert found == pytest.approx(expected, abs=1e-3)
