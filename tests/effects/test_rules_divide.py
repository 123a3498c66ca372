"""Rules at division: the paper's listing, what `divide` may write, and what it can only read."""

from __future__ import annotations

import random
from dataclasses import dataclass

import pytest
import torch
from helpers import step
from ruled import Species, pair_of_cells

import torchfilm as tf
from torchfilm.effect import Effect


def test_the_papers_divide_partitions_at_random():
    """As printed, but for the index of the species, which on whole tensors comes after the
    cells'."""

    def divide(parent, daughter1, daughter2):
        r1 = random.uniform(0.0, 1.0)
        r2 = 1 - r1
        daughter1.species[:, 0] = parent.species[:, 0] * r1
        daughter2.species[:, 0] = parent.species[:, 0] * r2

    scene = tf.Scene(tf.Rules(divide=divide), tf.Division(), Species(), founders=pair_of_cells())
    with pytest.warns(UserWarning, match="another run with the same seed has other numbers"):
        model = scene.bind(3)
    state = model.start()
    state = state.with_fields(divide_flag=torch.tensor([True, False] * 3))
    after = model.step(state, 0.1)
    first, second = after.species[[0, 3, 6]], after.species[[1, 4, 7]]
    assert torch.allclose(first[:, 0] + second[:, 0], torch.ones(3), rtol=1e-6)
    assert 0 < float(first[0, 0]) < 1
    assert (after.species[:, 1] == 1).all(), "the other species is copied"
    assert (after.species[[2, 5, 8]] == 1).all(), "the cell that did not divide keeps its own"
    assert (state.species == 1).all(), "the state before is frozen"


def test_divide_draws_for_each_division_and_not_for_the_batch():
    def divide(parent, daughter1, daughter2):
        r1 = parent.random()
        daughter1.species = parent.species * r1.unsqueeze(1)
        daughter2.species = parent.species * (1 - r1).unsqueeze(1)

    scene = tf.Scene(tf.Rules(divide=divide), tf.Division(), Species(), founders=pair_of_cells())
    whole = scene.bind(4).start()
    whole = whole.with_fields(divide_flag=torch.ones(8, dtype=torch.bool))
    after = step(scene, whole, 0.1)
    share = after.species[0::2, 0]
    assert torch.unique(share).numel() == 8 and ((share > 0) & (share < 1)).all()
    alone = step(scene, whole.select([2]), 0.1)
    assert torch.equal(alone.species, after.species[after.colony == 2])


def test_divide_may_set_flags_types_and_read_geometry():
    def divide(parent, daughter1, daughter2):
        daughter1.cellType = parent.cell_type + 1
        daughter2.growth_rate = daughter2.length * 0.5

    cells = tf.Cells([[0.0, 0.0]], [[1.0, 0.0]], 3.0, cell_type=[4])
    scene = tf.Scene(tf.Rules(divide=divide), tf.Growth(rate=0.0), tf.Division(), founders=cells)
    state = scene.bind().start().with_fields(divide_flag=torch.tensor([True]))
    after = step(scene, state, 0.1)
    assert after.cell_type.tolist() == [5, 4] and after.cell_type.dtype == torch.int64
    assert after.growth_rate.tolist() == [0.0, 0.5]


def test_division_views_refuse_what_makes_no_sense():
    def divided(divide):
        scene = tf.Scene(
            tf.Rules(divide=divide), tf.Division(), Species(), founders=pair_of_cells()
        )
        state = scene.bind().start()
        step(scene, state.with_fields(divide_flag=torch.ones(2, dtype=torch.bool)), 0.1)

    def write_parent(parent, daughter1, daughter2):
        parent.species = 1.0

    def write_length(parent, daughter1, daughter2):
        daughter1.length = 1.0

    def read_unknown(parent, daughter1, daughter2):
        return parent.specis

    def wrong_shape(parent, daughter1, daughter2):
        daughter1.species = torch.ones(5)

    with pytest.raises(AttributeError, match="can only be read"):
        divided(write_parent)
    with pytest.raises(AttributeError, match=r"daughter1\.length can only be read.*Division"):
        divided(write_length)
    with pytest.raises(AttributeError, match=r"'specis'.*species"):
        divided(read_unknown)
    with pytest.raises((ValueError, RuntimeError), match="species"):
        divided(wrong_shape)


IN_PLACE = {
    "one coordinate": ("daughter1.position", lambda parent, d1, d2: d1.position[:, 0].fill_(7.0)),
    "by another name": ("daughter2.position", lambda parent, d1, d2: d2.pos.mul_(2.0)),
    "length": ("daughter1.length", lambda parent, d1, d2: d1.length.mul_(2.0)),
    "length, and set": (
        "daughter1.length",
        lambda parent, d1, d2: setattr(d1, "length", d1.length.mul_(2.0)),
    ),
    "axis": ("daughter2.axis", lambda parent, d1, d2: d2.axis.neg_()),
    "radius": ("daughter1.radius", lambda parent, d1, d2: d1.radius.__setitem__(0, 0.25)),
    "volume": ("daughter1.volume", lambda parent, d1, d2: d1.volume.mul_(0.5)),
    "uid": ("daughter2.uid", lambda parent, d1, d2: d2.uid.add_(1)),
    "parent's position": ("parent.position", lambda parent, d1, d2: parent.position.add_(1.0)),
    "parent's field": ("parent.species", lambda parent, d1, d2: parent.species[:, 0].fill_(0.0)),
}


@pytest.mark.parametrize("kind", list(IN_PLACE))
def test_what_divide_can_only_read_cannot_be_changed_in_place(kind):
    """It would have no effect, and nobody would notice: told when the rule is tried, or else at the
    first division, by name."""
    name, divide = IN_PLACE[kind]
    scene = tf.Scene(tf.Rules(divide=divide), tf.Division(), Species(), founders=pair_of_cells())
    with pytest.raises(AttributeError, match=rf"{name}.*can only be read"):
        step(scene, flagged_to_divide(scene.bind().start()), 0.1)


def flagged_to_divide(state: tf.State) -> tf.State:
    return state.with_fields(divide_flag=torch.ones_like(state.divide_flag))


def test_fields_of_daughters_may_be_changed_in_place_and_geometry_worked_with():
    def divide(parent, daughter1, daughter2):
        daughter1.species[:, 0] = 3.0
        daughter2.species *= 2.0
        half = daughter1.length * 0.5  # a tensor of the rule's own
        half += parent.position[:, 0]

    scene = tf.Scene(tf.Rules(divide=divide), tf.Division(), Species(), founders=pair_of_cells())
    after = step(scene, flagged_to_divide(scene.bind().start()), 0.1)
    assert after.species.tolist() == [[3.0, 1.0], [2.0, 2.0]] * 2


def test_a_colony_that_is_not_finite_is_no_fault_of_the_rules():
    """NaN is not equal to itself, and a rule that read it has not changed it: such a colony is the
    driver's matter."""

    def update(cells):
        cells.growth_rate = 0.0 * cells.position[:, 0]

    def divide(parent, daughter1, daughter2):
        daughter1.growth_rate = 0.0 * daughter1.position[:, 0] + parent.position[:, 0]

    scene = tf.Scene(tf.Rules(update, divide), tf.Growth(), tf.Division(), founders=pair_of_cells())
    state = flagged_to_divide(scene.bind().start())
    position = state.position.clone()
    position[0, 0] = float("nan")
    assert step(scene, state.replace(position=position), 0.1).cells == 4


@dataclass(frozen=True)
class Plate(Effect):
    """A quantity of the colony."""

    stage = 60
    title = "plate"

    def declares(self, dim):
        return (
            tf.Field(
                "plate",
                "per colony",
                scope="colony",
                initial=lambda s, rows, values: 1.0 + rows.to(s.dtype),
            ),
        )

    def step(self, state, dt, values):
        return state


def test_divide_reads_the_colonys_own_quantities_and_cannot_write_them():
    def divide(parent, daughter1, daughter2):
        daughter1.growth_rate = daughter1.plate + parent.plate

    scene = tf.Scene(
        tf.Rules(divide=divide),
        tf.Growth(rate=0.0),
        tf.Division(),
        Plate(),
        founders=pair_of_cells(),
    )
    after = step(scene, flagged_to_divide(scene.bind(3).start()), 0.1)
    assert after.growth_rate[::2].tolist() == [
        2.0,
        2.0,
        4.0,
        4.0,
        6.0,
        6.0,
    ] and after.plate.tolist() == [1.0, 2.0, 3.0]
    wrong = tf.Scene(
        tf.Rules(divide=lambda p, d1, d2: setattr(d1, "plate", 3.0)),
        tf.Division(),
        Plate(),
        founders=pair_of_cells(),
    )
    with pytest.raises(tf.InputError, match=r"'plate'.*a colony's can only be read"):
        wrong.bind().start()


def test_what_a_divide_rule_writes_is_declared():
    def divide(parent, daughter1, daughter2):
        daughter1.growth_rate = parent.growth_rate * 2

    scene = tf.Scene(
        tf.Rules(divide=divide), tf.Growth(rate=1.0), tf.Division(), founders=pair_of_cells()
    )
    scene.bind().start()
    assert "growth" in {r for w, _, r in scene.bind().couplings() if w.startswith("rules")}


@pytest.mark.parametrize("in_place", [False, True])
def test_what_divide_changes_in_place_is_written(in_place):
    """A rule that writes into a field counts as one that sets it: where a rate goes by type, both
    are refused."""

    def divide(parent, daughter1, daughter2):
        if in_place:
            daughter1.growth_rate[:] = 2.0
        else:
            daughter1.growth_rate = 2.0

    division, founders = tf.Division(length=3.0), tf.Cells([[0.0, 0.0]], [[1.0, 0.0]])
    scene = tf.Scene(tf.Growth(), tf.Rules(divide=divide), division, founders=founders)
    rules = [e for e in scene.bind().effects if e.title == "rules at division"]
    assert rules[0].writes() == ("growth_rate",)
    by_type = scene.replace(tf.Growth(rate={0: 1.0}), tf.Rules(divide=divide), division)
    with pytest.raises(tf.InputError, match="growth_rate"):
        by_type.bind()


def test_rules_follow_the_poles():
    """Daughter 1 lies at the end to which the axis points back. After n divisions of a founder,
    2^(n − k) cells have an older pole of age k, and 2 have one of age n; young poles face."""

    def poles(parent, daughter1, daughter2):
        daughter1.back, daughter1.front = parent.back + 1, 0
        daughter2.back, daughter2.front = 0, parent.front + 1

    scene = tf.Scene(
        tf.Rules(None, poles, variables={"back": 0, "front": 0}),
        tf.Growth(rate=1.0), tf.Division(length=4.0, axis_noise=0.0), tf.Mechanics(dim=2),
    )  # fmt: skip
    *_, state = tf.simulate(scene, cells=32)
    older = torch.maximum(state.back, state.front).int()
    assert older.bincount().tolist() == [0, 16, 8, 4, 2, 2]
    assert bool((torch.minimum(state.back, state.front) == 0).all())
    half = 0.5 * (state.length + 2 * state.radius).double().unsqueeze(1) * state.axis.double()
    young = torch.where((state.front == 0).unsqueeze(1), half, -half) + state.position
    order = state.parent.argsort(stable=True)
    gap = (young[order[::2]] - young[order[1::2]]).norm(dim=1)
    assert bool((state.parent[order[::2]] == state.parent[order[1::2]]).all())
    # the step in which they divided has not moved them yet
    assert float(gap.max()) < 1e-5


def test_cells_are_not_removed_as_they_are_born():
    """It would be a variable that nothing reads: all daughters lived on."""

    def divide(parent, daughter1, daughter2):
        daughter2.remove_flag = True

    scene = tf.Scene(tf.Rules(None, divide), tf.Growth(rate=1.0), tf.Division(length=4.0), dim=2)
    with pytest.raises(tf.InputError, match=r"no remove_flag.*in update\(cells\).*doomed"):
        scene.bind()
    with pytest.raises(tf.InputError, match="no remove_flag"):
        of_parent = lambda parent, one, other: setattr(parent, "remove_flag", True)
        tf.Scene(tf.Rules(None, of_parent), tf.Growth(rate=1.0), tf.Division(), dim=2).bind()
    with pytest.raises(tf.InputError, match=r"Rules\.variables: remove_flag .* left out"):
        tf.Rules(None, divide, variables={"remove_flag": 0.0})


def test_what_the_message_says_removes_daughters():
    def update(cells):
        cells.remove_flag = cells.doomed > 0

    def divide(parent, daughter1, daughter2):
        daughter2.doomed = 1.0

    rules = tf.Rules(update, divide, variables={"doomed": 0.0})
    scene = tf.Scene(rules, tf.Growth(rate=1.0), tf.Division(length=4.0), dim=2)
    *_, state = tf.simulate(scene, until=4.0)
    assert state.cells == 1 and int(state.uid[0]) > 4
