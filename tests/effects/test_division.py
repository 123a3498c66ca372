"""Division: who divides and when, what becomes of geometry, ids and fields, and gradients'
copying."""

from __future__ import annotations

import math
from dataclasses import dataclass

import pytest
import torch
from dividing import flagged, row_of_cells
from helpers import ends, seeded, step
from recorded import assert_same_state

import torchfilm as tf
from torchfilm.effect import Effect
from torchfilm.effects import compiled_division, division

# --- criteria -------------------------------------------------------------------------------------


def test_by_flag_alone():
    scene = tf.Scene(tf.Division(), founders=row_of_cells(3))
    state = step(scene, flagged(scene, which=[1]), 0.1)
    assert state.cells == 4 and state.parent.tolist() == [-1, 1, 1, -1]


def test_flag_works_beside_a_criterion_and_is_cleared():
    scene = tf.Scene(tf.Division(length=4.0), founders=row_of_cells(2, 3.0))
    state = step(scene, flagged(scene, which=[0]), 0.1)
    assert state.cells == 3 and not state.divide_flag.any()
    assert step(scene, state, 0.1).cells == 3


def test_a_flagged_rule_divides_what_it_names():
    def update(cells):
        cells.divide_flag = cells.uid == 0

    scene = tf.Scene(tf.Rules(update), tf.Division(), founders=row_of_cells(3))
    state = step(scene, scene.bind(2).start(), 0.1)
    assert state.counts.tolist() == [4, 4]
    assert state.uid.tolist() == [3, 4, 1, 2] * 2


def test_one_threshold_for_each_colony():
    scene = tf.Scene(
        tf.Growth(rate=1.0, law="linear"),
        tf.Division(length=[2.5, 3.0, 9.0]),
        founders=row_of_cells(1),
    )
    state = scene.bind(3).start()
    for _ in range(3):
        state = step(scene, state, 0.25)
    assert state.counts.tolist() == [2, 1, 1]
    for _ in range(2):
        state = step(scene, state, 0.25)
    assert state.counts.tolist() == [2, 2, 1]
    assert state.division_threshold.tolist() == [2.5, 2.5, 3.0, 3.0, 9.0]


@pytest.mark.parametrize("criterion", ["length", "volume", "added"])
def test_drawn_thresholds_are_drawn_anew_for_each_daughter(criterion):
    scene = tf.Scene(tf.Division(**{criterion: tf.Uniform(3.5, 4.5)}), founders=row_of_cells(1))
    state = flagged(scene, 400)
    parents = state.division_threshold
    after = step(scene, state, 0.1)
    first, second = after.division_threshold.reshape(400, 2).T
    for drawn in (parents, first, second):
        assert ((drawn > 3.5) & (drawn < 4.5)).all()
        # four standard errors of the mean of 400 uniform draws, and of their spread
        assert float(drawn.mean()) == pytest.approx(4.0, abs=4 / math.sqrt(12 * 400))
        assert float(drawn.std()) == pytest.approx(1 / math.sqrt(12), rel=0.12)
    # independent: |correlation| of 400 pairs is below 0.2 but for one chance in 10⁴
    for a, b in ((parents, first), (parents, second), (first, second)):
        assert abs(float(torch.corrcoef(torch.stack([a, b]))[0, 1])) < 0.2


def test_birth_length_of_the_adder_is_the_daughters_own():
    scene = tf.Scene(tf.Division(added=1.0, fraction=0.375), founders=row_of_cells(1, 3.0))
    state = step(scene, flagged(scene), 0.1)
    assert torch.equal(state.birth_length, state.length)
    assert state.birth_length.tolist() == [0.5, 1.5]


# --- geometry -------------------------------------------------------------------------------------


def outer_ends(state: tf.State) -> torch.Tensor:
    """The −axis tip of each first daughter and the +axis tip of each second, caps included, (2, M,
    d)."""
    low, high = (torch.as_tensor(e) for e in ends(state))
    radius = state.radius.double().cpu()[:, None]
    axis = state.axis.double().cpu()
    return torch.stack([(low - radius * axis)[0::2], (high + radius * axis)[1::2]])


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("fraction", [0.5, 0.3])
def test_daughters_lengths_and_outer_ends(dim, fraction, device, dtype):
    cells = row_of_cells(5, 3.0, dim)
    scene = tf.Scene(tf.Division(fraction=fraction, axis_noise=0.0), founders=cells)
    before = flagged(scene, device=device, dtype=dtype)
    after = step(scene, before, 0.1)
    eps = torch.finfo(dtype).eps
    # of the 4 µm with caps; each daughter has caps of 1 µm
    wanted = [4 * fraction - 1, 4 * (1 - fraction) - 1] * 5
    wanted = torch.tensor(wanted, dtype=dtype, device=device)
    assert torch.allclose(after.length, wanted, rtol=0, atol=8 * eps)
    assert torch.equal(after.axis, before.axis.repeat_interleave(2, 0))
    low, high = (torch.as_tensor(e) for e in ends(before))
    out = before.radius.double().cpu()[:, None] * before.axis.double().cpu()
    # lengths of a few µm are rounded a few times each, and places up to 40 µm away in float64
    rounding = 16 * eps + 4 * 40 * torch.finfo(torch.float64).eps
    assert torch.allclose(
        outer_ends(after), torch.stack([low - out, high + out]), rtol=0, atol=rounding
    )
    # the two new caps touch, they neither overlap nor leave a gap
    inner = torch.as_tensor(ends(after)[1][0::2] - ends(after)[0][1::2])
    assert torch.allclose(
        inner.norm(dim=1), torch.ones(5, dtype=torch.float64), rtol=0, atol=rounding
    )


def test_fraction_for_each_colony():
    scene = tf.Scene(tf.Division(fraction=[0.3, 0.5]), founders=row_of_cells(1, 3.0))
    assert step(scene, flagged(scene, 2), 0.1).length.tolist() == pytest.approx(
        [0.2, 1.8, 1.0, 1.0], rel=1e-12
    )


def test_drawn_fractions():
    scene = tf.Scene(
        tf.Division(fraction=tf.Uniform(0.3, 0.7), axis_noise=0.0), founders=row_of_cells(1, 3.0)
    )
    first, second = step(scene, flagged(scene, 500), 0.1).length.reshape(500, 2).T
    assert torch.allclose(first + second, torch.full_like(first, 2.0), rtol=1e-14, atol=0)
    share = (first + 1) / 4
    assert ((share > 0.3) & (share < 0.7)).all()
    assert float(share.mean()) == pytest.approx(0.5, abs=4 * 0.4 / math.sqrt(12 * 500))
    assert float(share.std()) == pytest.approx(0.4 / math.sqrt(12), rel=0.12)


@pytest.mark.parametrize("dim", [2, 3])
def test_axis_noise_is_a_thousandth_on_each_component(dim):
    scene = tf.Scene(tf.Division(), founders=row_of_cells(1, dim=dim))
    after = step(scene, flagged(scene, 4096), 0.1)
    assert torch.allclose(
        after.axis.norm(dim=1), torch.ones(8192, dtype=torch.float64), rtol=0, atol=1e-12
    )
    across = after.axis[:, 1:]  # the founder lies along x
    # after normalising, the components across the axis keep their noise; four standard errors of sd
    # and mean
    for part in across.T:
        assert float(part.std()) == pytest.approx(0.001, rel=4 / math.sqrt(2 * 8192))
        assert float(part.mean()) == pytest.approx(0.0, abs=4 * 0.001 / math.sqrt(8192))
    first, second = across.reshape(4096, 2, dim - 1).unbind(1)
    assert abs(float(torch.corrcoef(torch.stack([first[:, 0], second[:, 0]]))[0, 1])) < 0.07


def test_axis_noise_zero_means_none():
    scene = tf.Scene(tf.Division(axis_noise=0.0), founders=row_of_cells(4))
    before = flagged(scene)
    assert torch.equal(step(scene, before, 0.1).axis, before.axis.repeat_interleave(2, 0))


def test_volume_of_two_daughters_is_the_parents(dtype):
    """With flat cuts refilled by caps of the same radius: π r² (l − 2r) + 2·(4/3)π r³ = V − (2π −
    4π/3) r³."""
    scene = tf.Scene(tf.Division(), founders=row_of_cells(1, 3.0))
    before = flagged(scene, dtype=dtype)
    lost = (2 - 4 / 3) * math.pi * 0.125
    assert float(step(scene, before, 0.1).volume.sum()) == pytest.approx(
        float(before.volume.sum()) - lost, rel=1e-6
    )


# --- ids and order --------------------------------------------------------------------------------


def test_ids_parents_and_order_through_a_growing_batch():
    scene = tf.Scene(
        tf.Growth(rate=tf.Uniform(0.7, 1.3)),
        tf.Division(length=tf.Uniform(3.0, 4.0)),
        founders=row_of_cells(3),
    )
    state = scene.bind(5, seed=3).start()
    ever = {(c, u) for c, u in zip(state.colony.tolist(), state.uid.tolist(), strict=True)}
    for _ in range(60):
        before, state = state, step(scene, state, 0.05)
        assert (torch.diff(state.colony) >= 0).all(), "cells of a colony do not stand side by side"
        ids = list(zip(state.colony.tolist(), state.uid.tolist(), strict=True))
        assert len(set(ids)) == len(ids), "an id twice in one colony"
        for birth in state.births:
            born = zip(
                state.colony[birth.first].tolist(),
                birth.uid[: len(birth.first)].tolist(),
                strict=True,
            )
            born = [
                *born,
                *zip(
                    state.colony[birth.second].tolist(),
                    birth.uid[len(birth.first) :].tolist(),
                    strict=True,
                ),
            ]
            assert not ever & set(born), "an id was given out twice"
            ever |= set(born)
            assert torch.equal(state.uid[birth.first], birth.uid[: len(birth.first)])
            assert torch.equal(state.parent[birth.first], birth.parents.uid)
            assert torch.equal(state.parent[birth.second], birth.parents.uid)
            assert torch.equal(state.colony[birth.first], birth.parents.colony)
            assert torch.equal(birth.second, birth.first + 1)
            alive = set(zip(before.colony.tolist(), before.uid.tolist(), strict=True))
            assert (
                set(zip(birth.parents.colony.tolist(), birth.parents.uid.tolist(), strict=True))
                <= alive
            )
            assert not set(
                zip(birth.parents.colony.tolist(), birth.parents.uid.tolist(), strict=True)
            ) & set(ids)
        most = torch.zeros(5, dtype=torch.int64).scatter_reduce(0, state.colony, state.uid, "amax")
        assert (state.next_uid > most).all()
    assert state.cells > 60
    assert [(c, u) for c, u in sorted(ever) if c == 0] == [
        (0, u) for u in range(int(state.next_uid[0]))
    ], "ids with holes"


def test_the_note_of_the_end_names_the_parents():
    scene = tf.Scene(tf.Division(), founders=row_of_cells(3))
    state = step(scene, flagged(scene, 2, which=[2, 4]), 0.1)
    (note,) = state.ended
    assert note.fate == "divided"
    assert note.colony_id.tolist() == [0, 1] and note.uid.tolist() == [2, 1]
    assert not step(scene, state, 0.1).ended, "the note must not be told again"


# --- fields ---------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Marks(Effect):
    """Fields of every kind that division must handle."""

    stage = 50
    title = "marks"

    def declares(self, dim):
        return (
            tf.Field(
                "carried",
                "copied",
                initial=lambda s, rows, values: 1.0 + s.uid.index_select(0, rows).double(),
            ),
            tf.Field("clock", "starts again", initial=7.0, at_division="reset"),
            tf.Field(
                "own",
                "a function of the newborn",
                dtype=torch.int64,
                initial=lambda s, rows, values: s.uid.index_select(0, rows),
                at_division="reset",
            ),
            tf.Field("pair", "two numbers", shape=(2,)),
            tf.Field("plate", "of the colony", scope="colony", initial=3.0),
        )

    def step(self, state, dt, values):
        return state


def test_fields_are_copied_or_start_anew():
    scene = tf.Scene(tf.Division(), Marks(), founders=row_of_cells(2))
    before = flagged(scene, 2, which=[1, 2])
    pair = torch.arange(8, dtype=torch.float64).reshape(4, 2)
    before = before.with_fields(
        clock=torch.full((4,), 99.0, dtype=torch.float64),
        pair=pair,
        plate=torch.tensor([5.0, 6.0], dtype=torch.float64),
    )
    after = step(scene, before, 0.1)
    assert after.carried.tolist() == [1.0, 2.0, 2.0, 1.0, 1.0, 2.0]
    assert after.clock.tolist() == [99.0, 7.0, 7.0, 7.0, 7.0, 99.0]
    assert after.uid.tolist() == [0, 2, 3, 2, 3, 1]
    assert after.own.tolist() == [0, 2, 3, 2, 3, 1]
    assert torch.equal(after.pair, pair[[0, 1, 1, 2, 2, 3]])
    assert after.plate.tolist() == [5.0, 6.0], "a field of the colony is not a matter of cells"


def test_4096_divisions_at_once(device, dtype):
    """Amounts conserved to 1e-6, fractions uniform, ids unique, parents right."""

    def divide(parent, daughter1, daughter2):
        share = parent.random()
        daughter1.amount = parent.amount * share
        daughter2.amount = parent.amount * (1 - share)

    count, colonies = 1024, 4
    cells = row_of_cells(count)
    scene = tf.Scene(
        tf.Rules(divide=divide, variables={"amount": 0.0}), tf.Division(), founders=cells
    )
    before = seeded(scene, cells, device, dtype, colonies=colonies)
    amount = 10.0 ** torch.linspace(-3, 3, before.cells, dtype=dtype, device=device)
    before = before.with_fields(
        divide_flag=torch.ones(before.cells, dtype=torch.bool, device=device), amount=amount
    )
    after = step(scene, before, 0.1)
    assert after.counts.tolist() == [2 * count] * colonies
    first, second = after.amount.reshape(-1, 2).T
    assert torch.allclose(first + second, amount, rtol=1e-6, atol=0)
    assert float(after.amount.double().sum()) == pytest.approx(
        float(amount.double().sum()), rel=1e-6
    )
    share = (first / amount).double()
    # uniform: Kolmogorov–Smirnov distance of 4,096 draws, exceeded by chance once in 10⁴
    empirical = torch.arange(1, 4097, dtype=torch.float64, device=device) / 4096
    assert float((share.sort().values - empirical).abs().max()) < 2.23 / math.sqrt(4096)
    for k in range(colonies):
        mine = after.colony == k
        assert sorted(after.uid[mine].tolist()) == list(range(count, 3 * count))
        assert after.parent[mine].tolist() == torch.arange(count).repeat_interleave(2).tolist()


def test_gradient_passes_through_the_copying():
    """Daughters' lengths are (l + 1)f − 1 and (l + 1)(1 − f) − 1; the sum of l² then has slope
    2 l₁ f + 2 l₂ (1 − f)."""
    scene = tf.Scene(tf.Division(fraction=0.3, axis_noise=0.0), founders=row_of_cells(1, 3.0))
    state = flagged(scene)
    length = state.length.clone().requires_grad_()
    after = step(scene, state.replace(length=length), 0.1)
    (slope,) = torch.autograd.grad((after.length**2).sum(), length)
    assert float(slope) == pytest.approx(2 * 0.2 * 0.3 + 2 * 1.8 * 0.7, rel=1e-12)
    (shift,) = torch.autograd.grad(
        step(scene, state.replace(length=length), 0.1).position[0, 0], length
    )
    # centre of the first daughter: ½(l₁ − l)·a, so its x moves by ½(f − 1)
    assert float(shift) == pytest.approx(0.5 * (0.3 - 1), rel=1e-12)


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("axis_noise", [0.0, 0.01, [0.0, 0.1, 0.2, 0.3]])
@pytest.mark.parametrize("caps", [2.0, 4 / 3])
def test_cells_divide_alike_by_kernels_and_by_torch(dim, axis_noise, caps, dtype, monkeypatch):
    """Colonies in which none, some and all cells are due, and one without cells: the same bits,
    since it must not matter whether numba has been loaded."""
    pytest.importorskip("numba")
    counts, generator = torch.tensor([3, 5, 0, 4]), torch.Generator().manual_seed(dim)
    divides = tf.Division(fraction=tf.Normal(0.5, 0.05), axis_noise=axis_noise)
    model = tf.Scene(tf.Growth(rate=1.0), divides, dim=dim).bind(4, seed=3, dtype=dtype)
    rows = torch.repeat_interleave(torch.arange(4), counts)
    draw = lambda *shape: torch.rand(*shape, generator=generator, dtype=dtype)
    axis = torch.nn.functional.normalize(draw(12, dim) - 0.5, dim=1)
    state = model.start().take(rows).replace(
        uid=torch.arange(12) + 7, parent=torch.arange(12) - 1, next_uid=torch.arange(4) * 100 + 20,
        length=3.0 + draw(12), radius=0.4 + 0.2 * draw(12), axis=axis,
        position=50 * draw(12, dim).double(),
    )  # fmt: skip
    due = torch.tensor([0, 0, 0, 1, 0, 1, 1, 0, 1, 1, 1, 1], dtype=torch.bool)
    bound = next(e for e in model.effects if e.title == "division")
    (rows,), fresh = torch.nonzero(due, as_tuple=True), bound._fresh(state)
    share = bound.values.fraction.of_rows(state, rows, "Division.fraction")
    given = share, bound.values.axis_noise, fresh, caps
    by_kernels = division.divide(state, rows, *given)
    monkeypatch.setattr(compiled_division, "kernels_loaded", lambda value: False)
    by_torch = division.divide(state, rows, *given)
    assert by_kernels.births[-1].rows.tolist() == [3, 5, 6, 8, 9, 10, 11]
    assert_same_state(by_kernels, by_torch)
    for name in ("first", "second", "uid", "length", "rows"):
        assert torch.equal(*(getattr(s.births[-1], name) for s in (by_kernels, by_torch)))


@pytest.mark.parametrize("called", [False, True])
def test_fields_of_any_type_divide_alike_by_kernels_and_by_torch(called, dtype, monkeypatch):
    """Rows of one number and of several, copied or begun anew, also where a function of the state
    gives the first values of a field, which may read the others before these begin anew."""
    pytest.importorskip("numba")
    fields = [
        tf.Field("mark", "whole numbers, two a cell", shape=(2,), dtype=torch.int64),
        tf.Field("age", "steps", dtype=torch.int32, initial=7, at_division="reset"),
        tf.Field("new", "yes or no", dtype=torch.bool, initial=True, at_division="reset"),
        tf.Field("half", "yes or no", dtype=torch.bool, initial=0.5, at_division="reset"),
        tf.Field("single", "one type for all", dtype=torch.float32, initial=0.1,
                 at_division="reset"),
        tf.Field("matrix", "three by two", shape=(3, 2), initial=2.5, at_division="reset"),
        tf.Field("of_colony", "one a colony", scope="colony"),
    ]  # fmt: skip
    if called:
        first = lambda state, rows: state.age.index_select(0, rows).to(dtype) + 0.5
        fields.append(tf.Field("told", "from age", initial=first, at_division="reset"))
    model = tf.Scene(tf.Growth(rate=1.0), tf.Division(length=tf.Uniform(3.5, 4.0))).bind(
        3, seed=2, dtype=dtype
    )
    state = model.start()
    for field in fields:
        state = state.declare(field)
    state = state.with_fields(
        mark=torch.arange(6).reshape(3, 2) - 2**40, age=torch.arange(3, dtype=torch.int32)
    ).replace(length=torch.full((3,), 4.5, dtype=dtype))
    bound = next(e for e in model.effects if e.title == "division")
    assert (bound._fresh(state) is None) == called
    by_kernels = bound.step(state, 0.1)
    monkeypatch.setattr(compiled_division, "kernels_loaded", lambda value: False)
    by_torch = bound.step(state, 0.1)
    assert by_kernels.cells == 6
    assert_same_state(by_kernels, by_torch)
    assert by_kernels.age.tolist() == [7] * 6 and bool(by_kernels.new.all())
    assert by_kernels.mark[0].tolist() == by_kernels.mark[1].tolist() == [-(2**40), 1 - 2**40]


class NeverDue(tf.Division):
    def due(self, state):
        return torch.zeros_like(state.divide_flag)


class Never(tf.Division):
    def step(self, state, dt, values):
        return state


@pytest.mark.parametrize("kind", [NeverDue, Never])
def test_a_division_of_ones_own_decides_for_itself(kind):
    """Whether numba has been loaded or not."""
    model = tf.Scene(tf.Growth(rate=1.0), kind(length=3.0)).bind()
    state = model.start()
    for _ in range(40):
        state = model.step(state, 0.1)
    assert state.cells == 1 and float(state.length) > 10


@pytest.mark.parametrize("other", [torch.float32, torch.float64])
def test_thresholds_of_another_type_than_lengths_stay_numbers(other, dtype):
    """An effect of the user's may write them so, past with_fields; draws for daughters are of the
    column's type."""
    scene = tf.Scene(tf.Growth(rate=1.0), tf.Division(length=tf.Uniform(3.0, 3.2)))
    state = scene.bind(dtype=dtype).start()
    threshold = torch.full((1,), 3.1, dtype=other)
    state = state.replace(
        length=torch.full((1,), 3.5, dtype=dtype),
        fields={**state.fields, "division_threshold": threshold},
    )
    bound = next(e for e in scene.bind(dtype=dtype).effects if e.title == "division")
    if other == dtype:
        found = bound.step(state, 0.1).division_threshold
        assert bool(((found >= 3.0) & (found <= 3.2)).all()) and found.numel() == 2
    else:  # as by torch: nothing is converted unasked
        with pytest.raises(RuntimeError, match="dtype"):
            bound.step(state, 0.1)
