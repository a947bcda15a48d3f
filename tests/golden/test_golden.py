"""The tiny seeded policies give the figures that ``make_golden.py`` stored.

Processors with AVX2 and AVX-512 differ by 1e-6 in them.
"""

import json
from typing import Any

import pytest
from make_golden import GOLDEN, SEEDS, measure

Figures = dict[str, Any]


@pytest.fixture(scope="module", params=SEEDS)
def pair(request: pytest.FixtureRequest) -> tuple[Figures, Figures]:
    """Measured figures of a policy, and those stored."""
    return measure(request.param), json.loads(GOLDEN.read_text())[str(request.param)]


@pytest.mark.parametrize(("figure", "tolerance"), [("loss", 1e-4), ("log", 1e-4)])
def test_losses_are_those_stored(pair: tuple[Figures, Figures], figure: str, tolerance: float) -> None:
    measured, stored = pair
    assert measured[figure] == pytest.approx(stored[figure], rel=tolerance, abs=1e-6)


def test_gradients_are_those_stored(pair: tuple[Figures, Figures]) -> None:
    """Their norms, and where they point: a wrong sign or order leaves the norm as it is."""
    measured, stored = (figures["gradients"] for figures in pair)
    assert measured.keys() == stored.keys()
    for name, (norm, *shares) in ((name, figures) for name, figures in stored.items() if figures):
        assert measured[name][0] == pytest.approx(norm, rel=1e-3), name
        assert measured[name][1:] == pytest.approx(shares, abs=2e-3), name


def test_actions_are_those_stored(pair: tuple[Figures, Figures]) -> None:
    measured, stored = (figures["actions"] for figures in pair)
    for found, expected in zip(measured, stored, strict=True):
        assert found == pytest.approx(expected, abs=1e-4)
