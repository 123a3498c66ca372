"""Rules: the paper's own listings, variables, contacts, removal, random draws, and clear errors."""

from __future__ import annotations

import contextlib

import pytest
import torch
from helpers import step
from ruled import pair_of_cells, run, same, short_update

import torchfilm as tf

# --- the paper's listings -------------------------------------------------------------------------


def paper_update(cells):
    for cell in cells:
        cell.growthRate = 0.035
        if cell.volume > 3:
            cell.divideFlag = True


def tensor_update(cells):
    cells.growthRate = 0.035
    cells.divideFlag = cells.volume > 3


def minutes_scene(update) -> tf.Scene:
    """Time in minutes, as the paper has it."""
    return tf.Scene(tf.Rules(update), tf.Growth(), tf.Division(), tf.Mechanics(dim=2))


def test_the_papers_update_doubles_every_twenty_minutes():
    """Volume grows by e^0.035 a minute; the founder, V = 2.094, passes 3 after ln(3/2.094)/0.035 =
    10.3 minutes."""
    scene = minutes_scene(paper_update)
    first = scene.bind().start()
    state = run(scene, first, 11, 1.0)
    assert state.cells == 1
    assert float(state.volume) == pytest.approx(float(first.volume) * 2 ** (11 / 19.804), rel=1e-4)
    assert run(scene, state, 1, 1.0).cells == 2


def test_loop_and_whole_tensors_do_the_same():
    states = [
        run(scene := minutes_scene(u), scene.bind(2, seed=4).start(), 60, 1.0)
        for u in (paper_update, tensor_update, short_update)
    ]
    assert states[0].cells >= 8
    assert same(states[0], states[1]) and same(states[1], states[2])


# --- variables ------------------------------------------------------------------------------------


def test_a_variable_of_the_users_own_keeps_its_value_and_is_inherited():
    def update(cells):
        cells.age = cells.age + cells.dt
        cells.divide_flag = (cells.age > 0.35) & (cells.uid < 2)

    scene = tf.Scene(
        tf.Rules(update, variables={"age": 0.0}), tf.Division(), founders=pair_of_cells()
    )
    state = run(scene, scene.bind(dtype=torch.float64).start(), 4)
    assert state.cells == 4
    assert state.age.tolist() == pytest.approx([0.4] * 4, rel=1e-12)


def test_a_first_value_is_the_first_value():
    scene = tf.Scene(
        tf.Rules(
            lambda cells: setattr(cells, "energy", cells.energy * 2), variables={"energy": 3.0}
        ),
        founders=pair_of_cells(),
    )
    first = scene.bind().start()
    assert first.energy.tolist() == [3.0, 3.0], "trying the rule must not run it"
    assert run(scene, first, 2).energy.tolist() == [12.0, 12.0]


def test_a_new_name_becomes_a_variable():
    def update(cells):
        cells.near = cells.position[:, 0] < 10
        cells.rank = cells.uid * 2
        cells.place = cells.position * 2.0
        cells.weight = 1

    scene = tf.Scene(tf.Rules(update), founders=pair_of_cells())
    state = run(scene, scene.bind().start(), 1)
    assert state.near.tolist() == [True, False] and state.near.dtype == torch.bool
    assert state.rank.tolist() == [0, 2] and state.rank.dtype == torch.int64
    assert state.place.shape == (2, 2) and float(state.place[1, 0]) == 40.0
    assert state.weight.tolist() == [1, 1]


def test_a_new_variable_from_a_loop():
    def update(cells):
        for cell in cells:
            cell.score = float(cell.uid) + 0.5

    scene = tf.Scene(tf.Rules(update), founders=pair_of_cells())
    assert run(scene, scene.bind().start(), 2).score.tolist() == [0.5, 1.5]


def test_cell_type_is_a_whole_number_and_drives_growth():
    def update(cells):
        cells.cell_type = (cells.pos[:, 0] > 10).long()
        cells.growth_rate = torch.where(cells.cell_type == 1, 1.0, 0.0)

    scene = tf.Scene(tf.Rules(update), tf.Growth(law="length"), founders=pair_of_cells())
    state = run(scene, scene.bind(dtype=torch.float64).start(), 1, 1.0)
    assert state.cell_type.tolist() == [0, 1] and state.cell_type.dtype == torch.int64
    assert state.length.tolist() == pytest.approx([2.0, 2 * 2.718281828459045], rel=1e-12)


def test_table_1_names():
    seen = {}

    def update(cells):
        seen.update(
            {
                n: getattr(cells, n).clone()
                for n in (
                    "pos",
                    "dir",
                    "length",
                    "radius",
                    "volume",
                    "area",
                    "cellType",
                    "growthRate",
                    "divideFlag",
                )
            }
        )

    cells = tf.Cells([[1.0, 2.0]], [[0.0, 3.0]], 2.0, 0.5, cell_type=[7])
    scene = tf.Scene(
        tf.Rules(update), tf.Growth(rate=0.25), tf.Division(length=4.0), founders=cells
    )
    step(scene, scene.bind(dtype=torch.float64).start(), 0.1)
    pi = 3.141592653589793
    assert seen["pos"].tolist() == [[1.0, 2.0]] and seen["dir"].tolist() == [[0.0, 1.0]]
    assert float(seen["volume"]) == pytest.approx(pi * 0.25 * (2 + 2 / 3), rel=1e-14)
    assert float(seen["area"]) == pytest.approx(2 * pi * 0.5 * 3, rel=1e-14)
    assert (
        seen["cellType"].tolist() == [7]
        and seen["growthRate"].tolist() == [0.25]
        and seen["divideFlag"].tolist() == [False]
    )


def test_time_step_and_count_are_readable():
    seen = []
    scene = tf.Scene(
        tf.Rules(lambda cells: seen.append((cells.time, cells.dt, cells.count, len(cells)))),
        founders=pair_of_cells(),
    )
    run(scene, scene.bind(3).start(), 2, 0.25)
    assert seen[-2:] == [(0.0, 0.25, 6, 6), (0.25, 0.25, 6, 6)]


# --- neighbours and colonies ----------------------------------------------------------------------


def test_contacts_and_their_count():
    """Three upright rods 1.02 µm apart touch in a row; the fourth is far off. The same in each
    colony, never across."""
    seen = {}

    def update(cells):
        i, j = cells.contacts()
        seen["pairs"] = {tuple(sorted(p)) for p in zip(i.tolist(), j.tolist(), strict=True)}
        seen["wide"] = cells.contacts(within=1.2)[0].numel()
        cells.touching = cells.contact_count()

    cells = tf.Cells([[0.0, 0.0], [1.02, 0.0], [2.04, 0.0], [30.0, 0.0]], [[0.0, 1.0]] * 4)
    scene = tf.Scene(tf.Rules(update), founders=cells)
    state = run(scene, scene.bind(2).start(), 1)
    assert state.touching.tolist() == [1, 2, 1, 0] * 2
    assert seen["pairs"] == {(0, 1), (1, 2), (4, 5), (5, 6)}
    assert seen["wide"] == 6, "the outer two of the three are 1.04 µm apart"


def test_greatest_smallest_and_sum_of_the_colony():
    seen = {}

    def update(cells):
        x = cells.position[:, 0]
        seen.update(
            max=cells.colony_max(x).tolist(),
            min=cells.colony_min(x).tolist(),
            sum=cells.colony_sum(x).tolist(),
        )

    cells = tf.Cells([[1.0, 0.0], [5.0, 0.0], [-3.0, 0.0]], [[1.0, 0.0]] * 3, colony=[0, 0, 1])
    scene = tf.Scene(tf.Rules(update), founders=cells)
    run(scene, scene.bind().start(), 1)
    assert seen == {"max": [5.0, 5.0, -3.0], "min": [1.0, 1.0, -3.0], "sum": [6.0, 6.0, -3.0]}


def test_rules_remove_cells():
    def update(cells):
        cells.remove_flag = cells.position[:, 0] > 10

    scene = tf.Scene(tf.Rules(update), founders=pair_of_cells())
    state = step(scene, scene.bind(2).start(), 0.1)
    assert state.uid.tolist() == [0, 0]
    (note,) = state.ended
    assert (
        note.fate == "removed" and note.uid.tolist() == [1, 1] and note.colony_id.tolist() == [0, 1]
    )


def test_rules_remove_cells_one_by_one():
    def update(cells):
        for cell in cells:
            if cell.uid == 0:
                cell.remove_flag = True

    scene = tf.Scene(tf.Rules(update), founders=pair_of_cells())
    assert step(scene, scene.bind().start(), 0.1).uid.tolist() == [1]


def test_removing_everyone_is_no_accident():
    def update(cells):
        cells.remove_flag = cells.time >= 0.2

    scene = tf.Scene(
        tf.Rules(update), tf.Growth(rate=1.0), tf.Division(length=3.5), tf.Mechanics(dim=2)
    )
    state = run(scene, scene.bind(2).start(), 6)
    assert state.cells == 0 and state.colonies == 2


# --- random draws ---------------------------------------------------------------------------------


def test_draws_belong_to_cell_and_step_and_not_to_the_batch():
    def update(cells):
        cells.one = cells.random()
        cells.two = cells.random()

    scene = tf.Scene(tf.Rules(update), founders=pair_of_cells())
    first = scene.bind(300).start()
    state = run(scene, first, 1)
    drawn = torch.cat([state.one, state.two])
    assert torch.unique(drawn).numel() == 1200 and ((drawn > 0) & (drawn < 1)).all()
    # mean ½ within four standard errors
    assert float(drawn.mean()) == pytest.approx(0.5, abs=4 / (12 * 1200) ** 0.5)
    part = run(scene, first.select([7, 3]), 1)
    assert torch.equal(part.one, torch.cat([state.one[14:16], state.one[6:8]]))
    later = run(scene, state, 1)
    assert not (later.one == state.one).any()
    assert not (run(scene, scene.bind(300, seed=1).start(), 1).one == state.one).any()


def test_random_growth_in_a_batch_is_random_growth_alone():
    def update(cells):
        cells.growth_rate = 0.5 + cells.random()

    scene = tf.Scene(
        tf.Rules(update), tf.Growth(), tf.Division(length=tf.Uniform(3.0, 4.0)), tf.Mechanics(dim=2)
    )
    whole = scene.bind(3, seed=9).start()
    alone = [run(scene, whole.select([k]), 40, 0.05) for k in range(3)]
    whole = run(scene, whole, 40, 0.05)
    assert whole.cells > 8
    for k in range(3):
        assert same(whole.select([k]), alone[k].select([0]))


# --- frozen states --------------------------------------------------------------------------------


def test_writing_in_place_leaves_the_old_state_alone():
    def update(cells):
        cells.age += 1.0
        cells.growth_rate[0] = 5.0
        rate = cells.growth_rate
        rate *= 2

    scene = tf.Scene(
        tf.Rules(update, variables={"age": 0.0}), tf.Growth(rate=1.0), founders=pair_of_cells()
    )
    old = scene.bind().start()
    new = step(scene, old, 0.0)
    assert old.age.tolist() == [0.0, 0.0] and old.growth_rate.tolist() == [1.0, 1.0]
    assert new.age.tolist() == [1.0, 1.0] and new.growth_rate.tolist() == [10.0, 2.0]


@pytest.mark.parametrize(
    "name", ["position", "axis", "length", "radius", "uid", "parent", "colony"]
)
def test_writing_into_what_is_read_only_never_reaches_the_state(name):
    """Whether it is refused or has no effect: the frozen state must not change behind its back."""

    def update(cells):
        getattr(cells, name)[0] = 1

    scene = tf.Scene(tf.Growth(rate=1.0), founders=pair_of_cells(gap=3.0))
    state = scene.bind().start()
    state = state.replace(**{name: getattr(state, name) + 3})
    before = {
        n: getattr(state, n).clone()
        for n in ("position", "axis", "length", "radius", "uid", "parent", "colony")
    }
    ruled = tf.Rules(update)
    # a colony that the batch has not is refused too
    with contextlib.suppress(AttributeError, RuntimeError, TypeError, IndexError):
        step(ruled, state, 0.1)
    for n, value in before.items():
        assert torch.equal(getattr(state, n), value), f"the rule changed {n} of the frozen state"


# --- clear errors ---------------------------------------------------------------------------------


def write(name, value):
    return lambda cells: setattr(cells, name, value)


@pytest.mark.parametrize(
    "name",
    [
        "position",
        "pos",
        "dir",
        "length",
        "radius",
        "volume",
        "area",
        "uid",
        "parent",
        "colony",
        "time",
        "dt",
        "count",
    ],
)
def test_what_table_1_only_reads_cannot_be_written(name):
    with pytest.raises(AttributeError, match="can only be read"):
        tf.Scene(tf.Rules(write(name, 1.0))).bind().start()


def test_a_misspelt_name_is_reported_with_those_that_exist():
    with pytest.raises(AttributeError, match=r"'lenght'.*length.*growth_rate"):
        tf.Scene(tf.Rules(lambda cells: cells.lenght), tf.Growth()).bind().start()


@pytest.mark.parametrize("shape", [(3,), (2, 2), (1, 2, 1)])
def test_a_wrong_shape_is_reported_before_anything_runs(shape):
    with pytest.raises(ValueError, match=r"cells\.growth_rate.*shape"):
        tf.Scene(
            tf.Rules(write("growth_rate", torch.ones(shape))), tf.Growth(), founders=pair_of_cells()
        ).bind().start()


def test_letters_that_changed_places_are_a_slip():
    def rule(cells):
        cells.gpf = 1.0

    scene = tf.Scene(tf.Rules(rule, variables={"gfp": 0.0}), dim=2)
    with pytest.raises(tf.InputError, match=r"cells\.gpf is new: did you mean 'gfp'"):
        scene.bind()


def test_a_new_variable_of_wrong_length_is_reported():
    with pytest.raises(ValueError, match=r"cells\.mine.*shape"):
        tf.Scene(tf.Rules(write("mine", torch.ones(5))), founders=pair_of_cells()).bind().start()


def test_a_value_that_is_no_number_is_reported_by_name():
    with pytest.raises((ValueError, TypeError), match="growth_rate"):
        tf.Scene(tf.Rules(write("growth_rate", "fast")), tf.Growth()).bind().start()


def test_a_variable_that_first_comes_up_in_mid_run_is_reported():
    def update(cells):
        if cells.time > 0.15:
            cells.late = 1.0

    scene = tf.Scene(tf.Rules(update), founders=pair_of_cells())
    with pytest.raises(tf.SimulationError, match=r"'late'.*variables="):
        run(scene, scene.bind().start(), 3)


@pytest.mark.parametrize(
    ("given", "message"),
    [((), "neither"), ((3,), r"Rules\.update"), (("no_such_file.py",), "No such file")],
)
def test_bad_rules_are_refused(given, message):
    with pytest.raises(tf.InputError, match=message):
        tf.Rules(*given)


@pytest.mark.parametrize("value", [float("nan"), "much", True])
def test_bad_first_values_are_refused(value):
    with pytest.raises(tf.InputError, match=r"variables\['age'\]"):
        tf.Rules(lambda cells: None, variables={"age": value})


@pytest.mark.parametrize("law", ["volume", "length", "linear"])
def test_a_negative_rate_from_a_rule_never_makes_a_negative_length(law):
    """Length stays at least 0 always: a rule that shrinks cells is either refused or stops at
    nothing."""
    scene = tf.Scene(
        tf.Rules(write("growth_rate", -1.0)), tf.Growth(law=law), founders=pair_of_cells()
    )
    try:
        state = run(scene, scene.bind().start(), 4, 1.0)
    except (tf.InputError, tf.SimulationError):
        return
    assert (state.length >= 0).all()


# --- couplings ------------------------------------------------------------------------------------


def test_what_a_rule_reads_and_writes_is_declared():
    scene = tf.Scene(tf.Rules(short_update), tf.Growth(), tf.Division(), founders=pair_of_cells())
    scene.bind().start()
    found = scene.bind().couplings()
    assert ("rules", "growth_rate", "growth") in found
    assert ("rules", "divide_flag", "division") in found


@pytest.mark.parametrize("name", ["volume", "area"])
def test_reading_a_derived_quantity_is_reading_the_length(name):
    """`cells.volume` changes as growth changes the length, so growth drives this rule."""

    def update(cells):
        cells.big = getattr(cells, name) > 3

    scene = tf.Scene(tf.Rules(update), tf.Growth(rate=1.0), founders=pair_of_cells())
    scene.bind().start()
    assert "growth" in {w for w, _, r in scene.bind().couplings() if r == "rules"}


def test_looking_for_contacts_is_reading_the_geometry():
    def update(cells):
        cells.touching = cells.contact_count()

    scene = tf.Scene(
        tf.Rules(update), tf.Growth(rate=1.0), tf.Mechanics(dim=2), founders=pair_of_cells()
    )
    scene.bind().start()
    assert {"growth", "mechanics"} <= {w for w, _, r in scene.bind().couplings() if r == "rules"}


def test_a_rule_that_would_fail_with_two_cells_is_reported_at_once_with_one():
    def update(cells):
        if cells.length > 3:
            cells.growth_rate = 1.0

    scene = tf.Scene(tf.Rules(update), tf.Growth(rate=1.0), tf.Division())
    with pytest.raises(
        tf.InputError, match=r"test_rules\.py, line \d+ \(if cells\.length > 3:\).*torch\.where"
    ):
        scene.bind().start()


def test_a_rule_that_names_a_new_variable_sees_one_founder_as_it_is():
    def update(cells):
        cells.age = cells.length * 0 + 2.0

    state = tf.Scene(tf.Rules(update), tf.Growth(rate=1.0), tf.Division()).bind().start()
    assert state.cells == 1 and state.age.shape == (1,)


@pytest.mark.parametrize("ask", [lambda x: x.item(), float, bool])
def test_one_number_of_all_cells_is_refused_where_cells_divide(ask):
    def update(cells):
        cells.growth_rate = 1.0 if ask(cells.length) else 0.0

    with pytest.raises(tf.InputError, match=r"test_rules\.py, line \d+ .*torch\.where"):
        tf.Scene(tf.Rules(update), tf.Growth(), tf.Division()).bind().start()
    assert tf.Scene(tf.Rules(update), tf.Growth()).bind().start().cells == 1


def test_a_rule_that_returns_values_is_refused():
    """They would be lost: rules write to the cells."""

    def update(cells):
        return {"growth_rate": cells.growth_rate * 2}

    words = r"update returns values by name, \['growth_rate'\].*cells\.growth_rate = "
    with pytest.raises(tf.InputError, match=words):
        tf.Scene(tf.Rules(update), tf.Growth(rate=1.0), dim=2).bind()
