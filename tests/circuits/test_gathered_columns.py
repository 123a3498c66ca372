"""Columns that kernels gather from where they lie in memory, and what they store."""

from __future__ import annotations

from dataclasses import dataclass

import pytest
import torch
from helpers import array
from traced import alone, ends, equal

import torchfilm as tf
from torchfilm.circuits.dilution import Start, half_way, part_way
from torchfilm.physics import capsule

F64 = torch.float64
TYPES = [torch.float64, torch.float32, torch.int64, torch.int32, torch.int8, torch.bool]


@dataclass(frozen=True)
class Marks(tf.Effect):
    """A field of some type, which a rate reads."""

    dtype: torch.dtype

    title = "marks"
    stage = 5

    def declares(self, dim):
        first = lambda state, rows, values: state.uid.index_select(0, rows) % 3
        return (tf.Field("mark", "of a cell", dtype=self.dtype, initial=first),)

    def step(self, state, dt, values):
        return state


def marked(u, s, p, cell):
    return {"a": p.k + cell.mark - 0.5 * u.a + cell.x * 0.25}


def decay(u, s, p, cell):
    return {"a": p.k - 0.5 * u.a}


@pytest.mark.parametrize("kind", TYPES, ids=str)
def test_columns_of_every_type_are_read(kind, dtype):
    made = ends(alone(Marks(kind), tf.Circuit(marked, species="a", k=0.25)), 1, dtype=dtype)
    assert len(made[0].fields["mark"].unique()) > 1 and made[0].fields["mark"].dtype == kind
    equal(*made)


@pytest.mark.parametrize("given", [torch.float64, torch.float32, torch.int64], ids=str)
def test_species_of_another_type_become_numbers_of_the_state(given, dtype):
    """Such as an array of numpy that a user has put in."""
    model = alone(tf.Circuit(decay, species="a", k=0.25)).bind(seed=1, dtype=dtype)
    state = model.start()
    first = torch.arange(state.cells)
    step = lambda x: model.step(state.with_fields(a=x), 0.25).fields["a"]
    one, other = step(first.to(given)), step(first.to(dtype))
    assert one.dtype == dtype and torch.equal(one, other)


@pytest.mark.parametrize("shape", [(3,), (40,), (12, 1)])
@pytest.mark.parametrize("name", ["a", "mark"])
def test_columns_of_another_length_are_refused(name, shape):
    scene = alone(Marks(F64), tf.Circuit(marked, species="a", k=0.25))
    model = scene.bind(seed=1, dtype=F64)
    state = model.start()
    assert state.cells == 12
    with pytest.raises(tf.InputError, match=rf"shape of .*{name}'? = .*\(12,\)"):
        model.step(state.with_fields(**{name: torch.ones(shape, dtype=F64)}), 0.25)


def test_a_gradient_does_not_change_how_much_growth_dilutes(dtype):
    """By torch, for the gradient, and by a kernel: the same bits."""
    length, radius = torch.rand(2, 1000, generator=torch.Generator().manual_seed(1), dtype=dtype)
    before = capsule.volume(length, radius) * 0.9
    one = half_way(length, radius, before)
    other = half_way(length.clone().requires_grad_(), radius, before)
    for name in ("length", "volume", "area", "before", "after"):
        assert torch.equal(getattr(one, name), getattr(other, name).detach())


def test_half_way_between_two_volumes(dtype):
    """In time: the volume there is the geometric mean of both."""
    length, radius = (
        torch.tensor([2.0, 3.0, 0.0, 5.0], dtype=dtype),
        torch.full((4,), 0.4).to(dtype),
    )
    own = capsule.volume(length, radius)
    before = own * torch.tensor([1.0, 0.9, 0.99, 0.5], dtype=dtype)
    made = half_way(length, radius, before)
    wanted = torch.minimum((before * own).sqrt(), own)
    wanted[2] = own[2]  # a sphere cannot have been smaller at this radius
    close = 20 * torch.finfo(dtype).eps
    assert array(made.volume) == pytest.approx(array(wanted), rel=close)
    assert array(made.before * made.after) == pytest.approx(array(before / own), rel=close)
    assert torch.equal(made.length[:1], length[:1]) and float(made.length[2]) == 0.0
    grown = length.clone().requires_grad_()
    again = half_way(grown, radius, before)  # by torch, for a gradient
    for name in ("length", "volume", "area", "before", "after", "end"):
        one, other = getattr(made, name), getattr(again, name)
        assert array(one) == pytest.approx(array(other.detach()), rel=close)
    assert again.volume.requires_grad


def test_what_only_growth_changes():
    """A species that growth dilutes, and one that it does not."""
    length, radius = torch.tensor([3.0, 4.0], dtype=F64), torch.full((2,), 0.5, dtype=F64)
    own = capsule.volume(length, radius)
    fields = {n: torch.tensor([2.0, 4.0], dtype=F64) for n in ("a", "b")}
    start = Start(fields, ("a",), half_way(length, radius, 0.8 * own))
    kept = start.kept()
    assert array(kept["a"]) == pytest.approx([1.6, 3.2], rel=1e-12)
    assert torch.equal(kept["b"], fields["b"])
    rows = torch.tensor([1])
    assert array(start.concentrations(rows)[0]) == pytest.approx([4 * 0.8**0.5, 4.0], rel=1e-12)


def test_a_colony_without_a_value_is_refused():
    """Not read beyond the values."""
    scene = lambda k: alone(tf.Circuit(decay, species="a", k=torch.tensor(k)))
    three = scene([1.0, 2.0, 3.0]).bind(3, seed=1).start()
    model = scene([1.0]).bind(1, seed=1)
    with pytest.raises(tf.InputError, match=r"colony_id = 2.*below 1"):
        model.step(three, 0.25)


def test_part_way_the_volume_has_grown_by_that_part(dtype):
    length = torch.tensor([2.0, 3.0, 0.0], dtype=dtype)
    radius = torch.full((3,), 0.4).to(dtype)
    own = capsule.volume(length, radius)
    before = own * torch.tensor([1.0, 0.9, 0.9], dtype=dtype)
    made = part_way(length, radius, before, 0.25)
    wanted = before + 0.25 * (own - before)
    wanted[2] = own[2]  # a sphere cannot have been smaller at this radius
    close = 20 * torch.finfo(dtype).eps
    assert array(capsule.volume(made, radius)) == pytest.approx(array(wanted), rel=close)
    assert torch.equal(made[0], length[0]) and float(made[2]) == 0.0
