"""Transport of a signal that cells give and take, against dense matrices of each colony: colonies
of several shapes, faces through which it flows, and each its own numbers."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import scipy.linalg
import torch
from test_operator import BOUNDARIES, SPACING, dense

from torchfilm.signals import uptake
from torchfilm.signals.exchange import stencil
from torchfilm.signals.grid import Grid
from torchfilm.signals.joint import JointMove, JointTransport, _parted
from torchfilm.signals.transport_rates import build_operator
from torchfilm.signals.transport_uptake import EVENTS, UptakeTransport
from torchfilm.signals.uptake import Eaters, solve
from torchfilm.tools.ragged import Groups
from torchfilm.tools.tangents import forward_mode, tangent, with_tangent

F64, DT = torch.float64, 0.3
# colonies of one shape are not side by side; the one before the last has no cells
SHAPES = [(6, 5, 1), (3, 4, 2), (6, 5, 1), (3, 4, 2), (7, 1, 1)]
CELLS = [4, 3, 5, 0, 3]
MIXED = [1.3, 0.0, 3e4, 0.4, 2.0]
ALIKE = [1.3] * 5
BACKENDS = pytest.mark.parametrize("compiled", [True, False], ids=["kernels", "torch"])
FACES = pytest.mark.parametrize("faces", ["periodic", "mixed"])


class Scene:
    """Five colonies with a field, and cells in them; the last cell meets a reservoir."""

    def __init__(self, faces: str, diffusion: list[float], compiled: bool, dtype=F64):
        rng = np.random.default_rng(4)
        shape = torch.tensor(SHAPES)
        self.grid = Grid(torch.zeros(5, 3, dtype=F64), shape, SPACING)
        self.diffusion = torch.tensor(diffusion, dtype=F64)
        self.decay, self.source = torch.as_tensor(rng.uniform(0.1, 2.0, (2, 5)))
        self.faces, self.dtype = BOUNDARIES[faces], dtype
        self.carried = [
            UptakeTransport(self.operator(b.colonies), b.shape, compiled)
            for b in self.grid.batches
        ]  # fmt: skip
        own = torch.repeat_interleave(torch.arange(5), torch.tensor(CELLS))
        size = (shape * torch.tensor(SPACING))[own]
        at = torch.as_tensor(rng.uniform(size=(len(own), 3))) * size
        self.at = stencil(self.grid, at, own, periodic=self.faces.periodic)
        self.groups = Groups(own, 5, ordered=True)
        self.field = torch.as_tensor(rng.uniform(0.2, 1.0, self.grid.nodes)).to(dtype)
        self.fed = torch.arange(len(own)) < len(own) - 1
        self.found = torch.where(self.fed, self.read(self.field.double()), 7.0)
        self.rng = rng

    def operator(self, ids: torch.Tensor):
        return build_operator(
            SHAPES[int(ids[0])], SPACING, diffusion=self.diffusion[ids], decay=self.decay[ids],
            source=self.source[ids], velocity=(2.0, -1.0, 0.5), boundary=self.faces,
            colonies=len(ids), dtype=self.dtype,
        )  # fmt: skip

    def read(self, field: torch.Tensor) -> torch.Tensor:
        return (self.at.weight * field[self.at.node]).sum(1)

    def spread(self, per_cell: torch.Tensor) -> torch.Tensor:
        """By loops, conc in each voxel."""
        out = torch.zeros(self.grid.nodes, dtype=F64)
        for node, weight, x in zip(self.at.node, self.at.weight, per_cell, strict=True):
            out.index_add_(0, node, weight * x / self.at.voxel_volume)
        return out

    def carried_by_matrices(self, given: torch.Tensor, losses: torch.Tensor, far: int = -1):
        """The field after DT and its mean, for what cells give to voxels and at which rate they
        take from them, 1/h: exactly, or by backward Euler where that is to be taken, and in the
        colony `far`."""
        end, mean = torch.empty(2, self.grid.nodes, dtype=F64)
        for k in range(5):
            op, mine = self.operator(torch.tensor([k])), self.grid.owner == k
            size = int(mine.sum())
            loss = losses[mine].numpy()
            whole = np.zeros((2 * size + 1,) * 2)
            whole[:size, :size] = dense(op) - np.diag(loss)
            whole[:size, -1] = op.gain.expand(1, *op.shape).flatten() + given[mine]
            whole[size:-1, :size] = np.eye(size) / DT
            u = self.field[mine].double().numpy()
            if k == far or float((op.loss.flatten() + losses[mine]).max()) * DT > EVENTS:
                matrix = np.eye(size) - DT * whole[:size, :size]
                after = np.linalg.solve(matrix, u + DT * whole[:size, -1])
                last = after
            else:
                after = scipy.linalg.expm(DT * whole) @ np.concatenate([u, 0 * u, [1.0]])
                after, last = after[:size], after[size:-1]
            end[mine], mean[mine] = torch.as_tensor(after), torch.as_tensor(last)
        return end, mean

    def joint(self) -> JointTransport:
        return JointTransport(
            self.grid, self.carried, self.at, torch.ones_like(self.found), self.groups, self.field,
            self.found, self.fed, 1e-9, DT,
        )  # fmt: skip

    def guesses(self) -> tuple[torch.Tensor, torch.Tensor]:
        """What cells give, or take; one neither. And the means that they expect."""
        released, mean = torch.as_tensor(self.rng.uniform(-1.0, 1.0, (2, len(self.found))))
        released[1] = 0.0
        return released * self.at.voxel_volume, 1.5 + mean


def close(one, other, rtol: float) -> None:
    torch.testing.assert_close(one, other, rtol=rtol, atol=rtol)


def allowed(made: Scene, owner: torch.Tensor) -> torch.Tensor:
    """Roundings of a series; and of a solve 1e-10 of the norm of what it solves for, some 1e5
    where that much comes through the faces."""
    far = made.diffusion * DT > EVENTS
    return torch.where(far, 1e-5, 1e-11)[owner]


@BACKENDS
@FACES
@pytest.mark.parametrize("diffusion", [MIXED, ALIKE], ids=["mixed", "alike"])
def test_a_step_with_cells_is_that_of_matrices(faces, compiled, diffusion):
    """What cells give, evenly; and what they take, in proportion to what is there."""
    made = Scene(faces, diffusion, compiled)
    joint, (released, mean) = made.joint(), made.guesses()
    assert joint.by_kernels == compiled
    gift, wanted = _parted(torch.where(made.fed, released, 0.0) / DT, mean)
    rate = wanted / mean
    end, average = made.carried_by_matrices(made.spread(gift), made.spread(rate))
    of_voxels, of_cells = (allowed(made, x) for x in (made.grid.owner, made.groups.owner))
    there, between = (torch.where(made.fed, made.read(x), 7.0) for x in (end, average))
    for _ in range(2):
        found = joint.moved(released, mean)
        assert bool(((found.end - end).abs() <= of_voxels).all())
        wanted = there, between, rate * between * DT
        for one, other in zip((found.at_end, found.mean, found.taken), wanted, strict=True):
            assert bool(((one - other).abs() <= of_cells * (1 + other)).all())
    assert bool((found.taken > 0).any()) and bool((gift > 0).any())


@FACES
def test_tangents_of_a_step_with_cells(faces):
    """By kernels against differences; of the field, of what cells give, of the means that they
    expect, and of a reservoir, together."""
    made = Scene(faces, MIXED, True)
    released, mean = made.guesses()
    released[1] = 0.02  # no kink
    field, found = made.field, made.found
    turns = [torch.as_tensor(made.rng.normal(size=x.shape)) for x in (field, found, released, mean)]

    def moved(*given):
        made.field, made.found = given[:2]
        return made.joint().moved(*given[2:])

    given = field, found, released, mean
    with forward_mode():
        slopes = [tangent(x) for x in moved(*map(with_tangent, given, turns))]
    ahead, back = (
        moved(*(x + h * turn for x, turn in zip(given, turns, strict=True))) for h in (1e-4, -1e-4)
    )
    for slope, one, other in zip(slopes, ahead, back, strict=True):
        close(slope, (one - other) / 2e-4, 1e-5)
        assert float(slope.abs().max()) > 0.1


@FACES
def test_tangents_of_what_is_neither_given_nor_taken(faces):
    """By kernels as by torch: half of a change is given and half is not taken, but all of it is
    given by a cell that expects nothing to take."""
    slopes, given = [], []
    for compiled in (True, False):
        made = Scene(faces, MIXED, compiled)
        released, mean = made.guesses()
        released, mean = 0.0 * released, torch.where(torch.arange(len(mean)) % 2 == 0, 0.0, mean)
        turn = torch.as_tensor(made.rng.uniform(0.5, 1.5, len(mean)))
        with forward_mode():
            found = made.joint().moved(with_tangent(released, turn), mean)
            slopes.append([tangent(x) for x in found])
        nothing = made.fed & (mean == 0)
        given.append(slopes[-1][3][nothing])
    for one, other in zip(*slopes, strict=True):
        close(one, other, 1e-7)
        assert float(one.abs().max()) > 1e-3
    assert len(given[0]) > 3 and bool((given[0] == 0).all())


@BACKENDS
@FACES
def test_uptake_solves_its_equation(faces, compiled):
    """Each cell takes what it grows by at the mean that it finds, and matrices give the same mean
    for the losses that follow from it."""
    made = Scene(faces, MIXED, compiled)
    size = len(made.found)
    volume, greatest, half, gain = torch.as_tensor(made.rng.uniform(0.5, 1.5, (4, size)))
    half, gain = 0.3 * half, 0.2 * gain
    eaters = Eaters(volume, greatest, half, gain, made.fed, made.at, made.groups, DT)
    taken = solve(eaters, made.grid, made.carried, made.field, made.found)
    assert not taken.failed.any() and bool((taken.amount > 0).all())
    growth = torch.log1p(taken.amount * gain / volume) / DT
    mean = half * growth / (greatest - growth)
    close(mean[~made.fed], made.found[~made.fed], 1e-12)
    rate = torch.where(made.fed, taken.amount / (mean * DT), 0.0)
    end, average = made.carried_by_matrices(0 * made.field, made.spread(rate))
    of_voxels, of_cells = (
        allowed(made, x).clamp(min=1e-7) for x in (made.grid.owner, made.groups.owner)
    )
    assert bool(((taken.end - end).abs() <= of_voxels).all())
    assert bool(((mean - made.read(average)).abs() <= of_cells)[made.fed].all())


@BACKENDS
def test_in_float32_amounts_are_kept(compiled):
    """But for the rounding of the field, and of a solve that ends by it."""
    made = Scene("closed", MIXED, compiled, torch.float32)
    made.decay, made.source = torch.zeros(2, 5, dtype=F64)
    batches = made.grid.batches
    made.carried = [UptakeTransport(made.operator(b.colonies), b.shape, compiled) for b in batches]
    released, mean = made.guesses()
    found = made.joint().moved(released, mean)
    given = torch.where(made.fed, released, 0.0).clamp(min=0.0)
    sums = lambda x, owner: torch.zeros(5, dtype=F64).index_add(0, owner, x.double())
    change = sums((found.end - made.field) * made.at.voxel_volume, made.grid.owner)
    close(change, sums(given - found.taken, made.groups.owner), 1e-6)


@BACKENDS
def test_a_colony_keeps_to_backward_euler(compiled):
    """Once it has taken it, though the series would do again; or guesses would go to and fro
    between two equations. It is told once, and of that colony alone."""
    made = Scene("mixed", ALIKE, compiled)
    joint, (released, mean) = made.joint(), made.guesses()
    hungry = released.clone()
    hungry[made.groups.owner == 2] = -1e5
    turned = []
    for asked in (released, hungry, released):
        found = joint.moved(asked, mean)
        turned.append(joint.turned.tolist())
        joint.turned.zero_()
    assert turned == [[False] * 5, [False, False, True, False, False], [False] * 5]
    gift, wanted = _parted(torch.where(made.fed, released, 0.0) / DT, mean)
    end, _ = made.carried_by_matrices(made.spread(gift), made.spread(wanted / mean), far=2)
    close(found.end, end, 1e-8)
    alone = made.carried_by_matrices(made.spread(gift), made.spread(wanted / mean))[0]
    assert float((found.end - alone).abs().max()) > 1e-3


def test_what_cells_took_too_much_of_is_taken_from_their_colony():
    """From where they are, down to half of what they find; the rest from all voxels alike; and
    more than there is, is told."""
    made = Scene("closed", ALIKE, True)
    joint = made.joint()
    joint = dataclasses.replace(joint, pool=torch.full_like(made.found, 0.1))
    apart = torch.zeros_like(made.found)
    owner, volume = made.groups.owner, made.at.voxel_volume
    apart[owner == 0], apart[owner == 1], apart[owner == 2] = -2.0, -40.0, -1e-3
    wanted = torch.full_like(apart, -50.0)
    taken = torch.where(made.fed, apart - wanted, 0.0)  # none beyond the box
    moved = JointMove(made.field, made.found, made.found, taken)
    end, beyond, left = joint.settled(moved, wanted)
    sums = lambda x, own: torch.zeros(5, dtype=F64).index_add(0, own, x)
    before, after = (sums(x * volume, made.grid.owner) for x in (made.field, end))
    asked = -sums(apart, owner)
    close(left, apart, 1e-12)
    assert asked[0] < before[0] and asked[1] > before[1]
    close(after, (before - asked).clamp(min=0.0), 1e-11)
    close(beyond, (asked - before).clamp(min=0.0), 1e-11)
    assert float(end.min()) >= 0.0
    for k in (3, 4):  # who took what there was
        mine = made.grid.owner == k
        assert torch.equal(end[mine], made.field[mine])


@BACKENDS
def test_a_solve_of_uptake_that_does_not_end_is_its_own_colonys(compiled, monkeypatch):
    """One that finds what it expected is at its end, and one without cells."""
    monkeypatch.setattr(uptake, "MOST", 2)
    made = Scene("mixed", ALIKE, compiled)
    size = len(made.found)
    half, gain = torch.full((2, size), 0.2, dtype=F64)
    greatest = torch.where(made.groups.owner == 2, 20.0, 0.0).double()
    one = torch.ones_like(half)
    eaters = Eaters(one, greatest, half, gain, made.fed, made.at, made.groups, DT)
    taken = solve(eaters, made.grid, made.carried, made.field, made.found)
    assert taken.failed.tolist() == [False, False, True, False, False]
    assert int(taken.iterations.max()) == 2
