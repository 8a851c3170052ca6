"""The reference cut in plane strain, with each of the plate's edges, against the earth-moving equation."""

import importlib.util
from pathlib import Path

import pytest

FILE = Path(__file__).parents[2] / "experiments" / "convergence" / "run.py"


@pytest.fixture(scope="module")
def run():
    spec = importlib.util.spec_from_file_location("convergence", FILE)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.long
def test_a_cut_with_an_edge_meets_the_earth_moving_equation(run):
    """In plane strain with mu_s = sin(phi), four cells deep; a square end carries ten times the vertical force."""
    equation = run.theory()[0]
    assert (equation["case"], round(equation["angle"], 1)) == ("slice", 37.2)
    found = run.measure(0.02, edge="bevel", friction_map="sin")
    for key in ("draft", "draft_second_half"):
        assert found[key] == pytest.approx(equation[key], rel=0.12)
    assert found["vertical"] == pytest.approx(equation["vertical"], abs=0.1 * equation["draft"])
    assert run.measure(0.02, friction_map="sin")["vertical"] > 5.0 * found["vertical"]
