"""BoundaryConditions: valid arguments, and the value of each colony."""

from __future__ import annotations

import pytest
import torch

from torchfilm.signals.boundary_conditions import (
    BoundaryConditions,
    Dirichlet,
    Face,
    NoFlux,
    Open,
    Periodic,
)
from torchfilm.tools.checks import InputError


def test_one_face_stands_for_both_ends():
    faces = BoundaryConditions(x=Periodic(), y=(Dirichlet(1.0), Open()))
    assert faces.pairs == (
        (Periodic(), Periodic()),
        (Dirichlet(1.0), Open(0.0)),
        (NoFlux(), NoFlux()),
    )
    assert faces.periodic == (True, False, False)


@pytest.mark.parametrize("pair", [(Periodic(), NoFlux()), (Dirichlet(1.0), Periodic())])
def test_a_periodic_face_needs_its_partner(pair):
    with pytest.raises(
        InputError, match=r"BoundaryConditions\.y.*periodic at both ends.*y=Periodic\(\)"
    ):
        BoundaryConditions(y=pair)


@pytest.mark.parametrize("given", ["open", (NoFlux(),), (NoFlux(), 1.0), 0.0])
def test_what_is_no_face_is_refused(given):
    with pytest.raises(InputError, match=r"BoundaryConditions\.x"):
        BoundaryConditions(x=given)


@pytest.mark.parametrize("make, name", [(Dirichlet, "Dirichlet.value"), (Open, "Open.outside")])
@pytest.mark.parametrize("value", [-1.0, float("nan"), "much", torch.tensor([1.0, -1.0])])
def test_a_concentration_is_a_number_that_is_not_negative(make, name, value):
    with pytest.raises(InputError, match=name):
        make(value)


def test_taking_colonies():
    places = torch.tensor([2, 0])
    faces = BoundaryConditions(
        x=(Dirichlet(torch.tensor([1.0, 2.0, 3.0])), Open(torch.tensor([4.0, 5.0, 6.0]))),
        y=(Dirichlet(7.0), NoFlux()),
    ).take(places)
    (low, high), (still, _), _ = faces.pairs
    assert low.outside_value().tolist() == [3.0, 1.0]
    assert high.outside_value().tolist() == [6.0, 4.0]
    assert still == Dirichlet(7.0)
    assert Face().outside_value() == 0.0
