"""Cells that are added to colonies during a run."""

from __future__ import annotations

import numpy as np
import pytest
import torch

import torchfilm as tf

FIRST = {"gfp": 2.0}


def made(u, s, p, cell):
    return {"gfp": 5.0 - u.gfp}


def scene_of(*more: tf.Effect, **options) -> tf.Scene:
    founders = tf.inoculum(3, 6.0, types={0: 1.0})
    return tf.Scene(
        tf.Growth(rate={0: tf.Normal(1.0, 0.1), 1: 0.7}),
        tf.Division(length=tf.Uniform(3.5, 4.5)), tf.Mechanics(dim=2),
        tf.Circuit(made, species="gfp", initial=FIRST), *more,
        **{"founders": founders, "dt": 0.05, **options},
    )  # fmt: skip


def drop(count: int = 2, **options) -> tf.Cells:
    return tf.inoculum(count, 3.0, **{"types": {1: 1.0}, "centre": (15.0, 0.0), **options})


def grown(model: tf.Model, steps: int, state: tf.State | None = None) -> tf.State:
    state = model.start() if state is None else state
    for _ in range(steps):
        state = model.step(state)
    return state


def alike(one: tf.State, other: tf.State) -> bool:
    columns = one.cell_columns(), other.cell_columns()
    return all(torch.equal(columns[0][n], columns[1][n]) for n in columns[0])


def test_they_start_as_founders_and_the_others_stay():
    model = scene_of().bind(3)
    before = grown(model, 30)
    state = model.add(before, drop(), [0, 2])
    assert (state.counts - before.counts).tolist() == [2, 0, 2]
    new = state.uid >= before.next_uid[state.colony]
    assert new.sum() == 4 and (state.parent[new] == -1).all()
    assert alike(state.take(torch.nonzero(~new)[:, 0]), before)
    assert (state.cell_type[new] == 1).all() and (state.gfp[new] == 2.0).all()
    assert (state.growth_rate[new] == 0.7).all()
    thresholds = state.division_threshold[new]
    assert ((thresholds > 3.5) & (thresholds < 4.5)).all() and len(set(thresholds.tolist())) == 4
    assert state.uid[new].tolist() == [
        int(before.next_uid[k]) + i for k in (0, 2) for i in range(2)
    ]
    assert (state.next_uid - before.next_uid).tolist() == [2, 0, 2]
    end = grown(model, 40, state)
    assert set(end.cell_type[end.colony == 0].tolist()) == {0, 1}
    assert set(end.cell_type[end.colony == 1].tolist()) == {0}


def test_a_colony_does_not_change_by_what_comes_to_others():
    scene = scene_of()
    model = scene.bind(3)
    state = grown(model, 20)
    some, none = grown(model, 30, model.add(state, drop(), [0])), grown(model, 30, state)
    for k in (1, 2):
        assert alike(some.select([k]), none.select([k]))
    alone = scene.bind(1, streams=[2])
    both = grown(model, 30, model.add(state, drop(), [1, 2])).select([2])
    assert alike(both, grown(alone, 30, alone.add(grown(alone, 20), drop())))


def test_colony_numbers_say_where_each_comes():
    model = scene_of().bind(3)
    cells = tf.Cells(
        [[15.0, 0.0], [20.0, 0.0], [15.0, 5.0]], [1.0, 0.0], cell_type=[1, 1, 1], colony=[2, 0, 2]
    )
    first = model.start()
    state = model.add(first, cells)
    assert (state.counts - first.counts).tolist() == [1, 0, 2]
    assert state.position[state.colony == 2][-2:].tolist() == [[15.0, 0.0], [15.0, 5.0]]
    empty = cells.position[:0]
    nobody = tf.Cells(empty, empty, np.empty(0), np.empty(0), cell_type=np.empty(0, int))
    assert alike(model.add(first, nobody), first)


def test_molecules_of_those_that_come_are_whole_numbers():
    circuit = tf.Circuit(
        [tf.Reaction({}, {"gfp": 1}, 5.0), tf.Reaction({"gfp": 1}, {}, 1.0)],
        species="gfp", initial={"gfp": 7.3}, molecules_per_unit=1.0, method="tau_leap",
    )  # fmt: skip
    model = tf.Scene(circuit, tf.Growth(rate=0.5), dim=2, dt=0.1).bind(2)
    before = grown(model, 5)
    state = model.add(before, tf.inoculum(50, 20.0))
    new = state.uid >= before.next_uid[state.colony]
    molecules = state.gfp * state.volume
    assert torch.equal(state.gfp[~new], before.gfp)
    assert torch.allclose(molecules[new], molecules[new].round(), atol=1e-3)
    assert len(set(molecules[new].round().tolist())) == 2  # 7.3 of a volume: up or down


def test_a_file_tells_of_them(tmp_path):
    scene = scene_of()
    run, model = tf.simulate(scene, until=2.0, colonies=2, record=tmp_path / "a.h5"), scene.bind(2)
    state = next(run)
    while state.time < 2.0 - 1e-9:
        added = abs(state.time - 0.5) < 1e-9
        state = run.send(model.add(state, drop(), [1])) if added else next(run)
    run.close()
    with tf.Results(tmp_path / "a.h5") as results:
        lineage = results.lineage()
        table = results.table()
    come = np.flatnonzero((lineage.parent < 0) & (lineage.born > 0))
    assert lineage.colony[come].tolist() == [1, 1] and lineage.born[come] == pytest.approx(0.5)
    assert lineage.birth_length[come] == pytest.approx(2.0)
    kinds = table["cell_type"][table["frame"] == table["frame"].max()]
    sizes = lineage.clone_sizes(1)
    assert sum(sizes[int(lineage.cell[k])] for k in come) == int((kinds == 1).sum()) > 2


@pytest.mark.parametrize("resumed", [True, False])
def test_a_run_goes_on_from_them(tmp_path, resumed):
    """As one that was not interrupted, also in the same file."""
    scene, path = scene_of(), tmp_path / "a.h5"
    model = scene.bind(2)
    whole = grown(model, 20, model.add(grown(model, 10), drop(), [1]))
    for _ in tf.simulate(scene, until=0.5, colonies=2, record=path):
        pass
    with tf.Results(path) as results:
        state = model.add(results.state(scene), drop(), [1])
    record = tf.Recorder(path, scene, append=True) if resumed else tmp_path / "b.h5"
    *_, end = tf.simulate(scene, state, until=1.5, record=record)
    assert alike(end, whole)
    with tf.Results(path if resumed else record) as results:
        lineage = results.lineage()
    come = np.flatnonzero((lineage.parent < 0) & (lineage.colony == 1))
    assert len(come) == 2 + 3 and len(set(lineage.cell[come])) == 5
    # a file that begins with them does not know since when they are there
    assert (lineage.born[come] == 0.5).sum() == (2 if resumed else 0)


def recorded(path, change, at: float = 0.5, until: float = 1.0, **options) -> tf.State:
    """The end of a run of two colonies whose state is changed at one time."""
    scene = scene_of()
    run, model = tf.simulate(scene, until=until, colonies=2, record=path), scene.bind(2)
    state = next(run)
    while state.time < until - 1e-9:
        due = abs(state.time - at) < 1e-9
        state = run.send(change(model, state)) if due else next(run)
    run.close()
    return state


def test_what_comes_and_goes_between_two_steps_has_never_lived(tmp_path):
    def change(model, state):
        state = model.add(state, drop(), [1])
        last = (state.colony == 1) & (state.uid == state.next_uid[1] - 1)
        return state.remove(last, "removed")

    end = recorded(tmp_path / "a.h5", change)
    with tf.Results(tmp_path / "a.h5") as results:
        lineage = results.lineage()
    come = np.flatnonzero((lineage.parent < 0) & (lineage.born > 0))
    assert len(come) == 1
    alive = (lineage.fate == "alive") & (lineage.colony == 1)
    assert alive.sum() == end.counts[1]


def test_a_detached_state_still_tells_of_them(tmp_path):
    def change(model, state):
        state = model.add(state, drop(), [0])
        return model.add(state.detach().to("cpu"), drop(1, centre=(-20.0, 0.0)), [1])

    recorded(tmp_path / "a.h5", change)
    with tf.Results(tmp_path / "a.h5") as results:
        lineage = results.lineage()
    assert sorted(lineage.colony[(lineage.parent < 0) & (lineage.born == 0.5)]) == [0, 0, 1]


def test_what_came_and_went_before_a_resume_has_never_lived(tmp_path):
    scene, path = scene_of(), tmp_path / "a.h5"
    model = scene.bind(2)
    for _ in tf.simulate(scene, until=0.2, colonies=2, record=path):
        pass
    with tf.Results(path) as results:
        state = model.add(results.state(scene), drop(), [0])
    state = state.remove(state.uid == state.next_uid[state.colony] - 1, "removed")
    record = tf.Recorder(path, scene, append=True)
    *_, end = tf.simulate(scene, state, until=0.3, record=record)
    with tf.Results(path) as results:
        lineage = results.lineage()
    assert (lineage.fate == "alive").sum() == end.cells
    assert np.isclose(lineage.born, 0.2).sum() == 1


@pytest.mark.parametrize("typed", [True, False])
def test_they_are_as_the_first_cells_of_the_model(typed):
    given = tf.Cells([[0.0, 0.0]], [1.0, 0.0], cell_type=[1] if typed else None)
    other = tf.Cells([[0.0, 0.0]], [1.0, 0.0], cell_type=None if typed else [1])
    scene = tf.Scene(tf.Growth(rate=1.0), founders=other, dim=2)
    model = scene.bind(cells=given)
    assert model.add(model.start(), given).cells == 2
    with pytest.raises(tf.InputError, match="cell_type, as the founders are"):
        model.add(model.start(), other)


def test_a_file_that_begins_with_them_goes_on(tmp_path):
    scene, path = scene_of(), tmp_path / "a.h5"
    model = scene.bind(2)
    state = model.add(grown(model, 4), drop(), [1])
    for _ in tf.simulate(scene, state, until=state.time, record=path):
        pass
    *_, end = tf.simulate(scene, state, until=0.5, record=tf.Recorder(path, scene, append=True))
    with tf.Results(path) as results:
        lineage = results.lineage()
    named = [*zip(lineage.colony.tolist(), lineage.cell.tolist(), strict=True)]
    assert len(set(named)) == len(named) and (lineage.parent < 0).sum() == 3 + 3 + 2
    assert alike(end, grown(model, 6, state))


def test_reports_stay_and_births_are_past():
    model = scene_of().bind(2)
    state = model.start()
    while not state.births:
        state = model.step(state)
    after = model.add(state, drop(), [0])
    assert after.births == () and after.reports == state.reports
    few = state.remove(state.uid >= state.next_uid[state.colony] - 2, "removed")
    assert model.add(few, drop(), [0]).cells == few.cells + 2
    with pytest.raises(tf.InputError, match="between two steps"):
        model.add(state.replace(span=(0.0, 0.1)), drop())


def test_variables_of_rules_and_further_fields_have_first_values():
    def up(cells):
        cells.bright = 2.0 * cells.length

    model = scene_of(tf.Rules(up)).bind()
    state = model.start().declare(tf.Field("mark", "of the user", initial=3.0))
    state = model.add(state, drop())
    assert state.bright[-2:].tolist() == [0.0, 0.0] and state.mark.tolist() == [3.0] * 5
    end = model.step(state)
    assert end.bright[-2:].tolist() == pytest.approx([4.0, 4.0])


def test_recorded_growth_does_not_take_them():
    scene = tf.Scene(
        tf.Growth(rate=1.0), tf.Division(length=4.0), tf.Mechanics(dim=2),
        tf.Circuit(made, species="gfp"), dt=0.1,
    )  # fmt: skip
    model = scene.bind(2)
    replay = tf.Replay(model, tf.GrowthRecording(scene, streams=range(2), seed=0))
    state = replay.step(replay.start())
    with pytest.raises(tf.InputError, match=r"cells were added .*Step the model itself"):
        replay.step(model.add(state, tf.Cells.single(2)))


def with_column(**options) -> tf.Scene:
    founders = tf.Cells([[0.0, 0.0]], [1.0, 0.0], cell_type=[0], extra={"age": [3.0]})
    return scene_of(founders=founders, **options)


def test_columns_come_along():
    model = with_column().bind()
    state = model.add(
        model.start(), tf.inoculum(2, 9.0, types={1: 1.0}, extra={"age": 7, "gfp": 1})
    )
    assert state.age.tolist() == [3.0, 7.0, 7.0] and state.gfp.tolist() == [2.0, 1.0, 1.0]


@pytest.mark.parametrize(
    ("add", "said"),
    [
        (lambda m, s: m.add(s, s), "a tf.Cells, such as"),
        (lambda m, s: m.add(s, drop(dim=3, centre=(0, 0, 0))), "'3-D'.*2-D, as the state"),
        (lambda m, s: m.add(s, tf.Cells.single(2)), "'without cell_type'.*with cell_type"),
        (lambda m, s: m.add(s, drop()), "with 'age', which the founders brought.*extra="),
        (lambda m, s: m.add(s, drop(extra={"gfq": 1.0})), "extra = 'gfq'.*'gfp'"),
        (lambda m, s: m.add(s, drop(extra={"age": 1.0}), [1]), "places from 0 to 0"),
        (lambda m, s: m.add(s, drop(extra={"age": 1.0}, colonies=2)), "colony = 1 .*below 1"),
        (
            lambda m, s: m.add(s.select([0]), drop(extra={"age": 1.0}, colonies=2), [0]),
            "left out, as the cells have colony numbers",
        ),
    ],
)
def test_what_is_refused(add, said):
    model = with_column().bind()
    with pytest.raises(tf.InputError, match=said):
        add(model, model.start())


def test_cells_outside_of_the_medium_are_refused():
    medium = tf.Medium(a=tf.Signal(10.0), box=((-9, -9), (9, 9)), spacing=3.0, depth=1.0)
    model = scene_of(medium).bind()
    state = model.start()
    with pytest.raises(tf.InputError, match="outside"):
        model.add(state, drop(centre=(50.0, 0.0)))
    assert model.add(state, drop(centre=(-5.0, 0.0))).cells == 5


def test_a_medium_grows_around_them():
    medium = tf.Medium(
        a=tf.Signal(10.0), box=((-9, -9), (9, 9)), spacing=3.0, depth=1.0, outside="grow"
    )
    model = scene_of(medium).bind(2)
    state = model.add(grown(model, 3), drop(centre=(50.0, 0.0)), [1])
    end = grown(model, 3, state)
    assert not tf.failures(end)
    low, high = (end.layout.grid.origin, end.layout.grid.origin + 3.0 * end.layout.grid.shape)
    assert (high[1, 0] > 50.0) and (high[0, 0] < 50.0) and (low[:, 0] < 0).all()
