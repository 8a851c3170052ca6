from types import SimpleNamespace

import pytest

from sgns.evaluation.overlap import overlap_warning, seen_before


def simulator(fitted_on, validation_runs):
    return SimpleNamespace(
        basis=SimpleNamespace(fitted_on=fitted_on),
        card={"settings": {"validation_runs": validation_runs}},
    )


@pytest.mark.parametrize(
    ("fitted_on", "validation", "expected"),
    [
        (["a", "b"], ["c"], ([], [])),
        (["a", "x"], ["c"], (["x"], [])),
        (["a"], ["y"], ([], ["y"])),
        (["x"], ["x", "y"], (["x"], ["y"])),  # a training run that also served for validation
        (None, [], ([], [])),
    ],
)
def test_what_was_seen_before(fitted_on, validation, expected):
    assert seen_before(simulator(fitted_on, validation), ["x", "y"]) == expected


def test_checkpoint_that_does_not_tell_its_validation_runs():
    known = SimpleNamespace(basis=SimpleNamespace(fitted_on=["x"]), card={})
    assert seen_before(known, ["x", "y"]) == (["x"], [])


def test_warning_counts_and_names():
    judged = SimpleNamespace(runs=[1, 2, 3], trained_on=["x", "y"], chosen_by=[])
    assert "2 of the 3 evaluated runs" in overlap_warning(judged) and "(x, …)" in overlap_warning(judged)
    assert overlap_warning(SimpleNamespace(runs=[1], trained_on=[], chosen_by=[])) == ""
