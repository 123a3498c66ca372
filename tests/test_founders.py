"""Founders that are drawn for each colony."""

import numpy as np
import pytest
import torch

import torchfilm as tf
from design import OnFraction, Parameter, Search

RADIUS = 8.0


def mixed(seed):
    return tf.inoculum(6, RADIUS, types={0: 0.5, 1: 0.5}, seed=seed)


def scene(founders=mixed, **growth) -> tf.Scene:
    return tf.Scene(
        tf.Growth(**growth or {"rate": 1.0}), tf.Division(length=4.0), tf.Mechanics(dim=2),
        founders=founders,
    )  # fmt: skip


def places(state: tf.State, colony: int) -> torch.Tensor:
    return state.position[state.colony == colony]


def test_each_stream_has_founders_of_its_own():
    first = scene().bind(3).start()
    assert first.counts.tolist() == [6, 6, 6]
    assert not torch.equal(places(first, 0), places(first, 1))
    assert not torch.equal(places(first, 1), places(first, 2))
    assert [int(first.cell_type[first.colony == k].sum()) for k in range(3)] == [3, 3, 3]


def test_they_depend_on_the_seed_and_the_stream_alone():
    whole = scene().bind(3).start()
    some = scene().bind(4, streams=[2, 2, 0, 9]).start()
    assert torch.equal(places(some, 0), places(whole, 2))
    assert torch.equal(places(some, 1), places(whole, 2))
    assert torch.equal(places(some, 2), places(whole, 0))
    assert not torch.equal(places(scene().bind(1, seed=1).start(), 0), places(whole, 0))


def test_a_colony_alone_has_the_same_bits():
    *_, both = tf.simulate(scene(), until=1.0, colonies=2)
    *_, alone = tf.simulate(scene(), until=1.0, streams=[1], colonies=1)
    assert torch.equal(places(both, 1), places(alone, 0))


def test_colonies_may_have_different_numbers_of_them():
    some = scene(lambda seed: tf.inoculum(2 + seed % 3, RADIUS, seed=seed)).bind(20).start()
    assert set(some.counts.tolist()) == {2, 3, 4}


def test_a_run_resumes(tmp_path):
    *_, whole = tf.simulate(scene(), until=1.0, colonies=2)
    for _ in tf.simulate(scene(), until=0.5, colonies=2, record=tmp_path / "run.h5"):
        pass
    with tf.Results(tmp_path / "run.h5") as results:
        *_, end = tf.simulate(scene(), results.state(scene()), until=1.0)
    assert torch.equal(whole.position, end.position)


def test_a_model_bound_to_a_state_starts_from_the_same():
    model = scene().bind(2, seed=3)
    again = scene().bind(state=model.step(model.start()))
    assert torch.equal(again.start().position, model.start().position)


def test_a_scene_keeps_the_function():
    other = scene().replace(dt=0.05)
    assert other.draw is mixed and "6 founder(s), drawn for each colony" in other.headline
    assert scene() == scene() and scene() != scene(lambda seed: tf.inoculum(6, 4.0, seed=seed))
    given = scene().replace(founders=tf.inoculum(3, RADIUS))
    assert given.draw is None and given.founders.count == 3


def test_growth_is_recorded_for_each_stream():
    def reads(u, s, p, cell):
        return {"gfp": p.make - u.gfp}

    def of(make):
        circuit = tf.Circuit(reads, species="gfp", make=make)
        return scene().replace(*scene().effects, circuit)

    recording = tf.GrowthRecording(of(1.0), streams=range(2), seed=0)
    model = of(2.0).bind(2, seed=0)
    replay, state = tf.Replay(model, recording), model.start()
    for _ in range(20):
        state = replay.step(state)
    *_, full = tf.simulate(of(2.0), until=0.5, colonies=2, seed=0)
    assert torch.equal(state.position, full.position) and torch.equal(state.gfp, full.gfp)
    other = tf.Scene(*of(1.0).effects, founders=lambda seed: tf.inoculum(6, 9.0, seed=seed))
    for changed in (other.bind(2, seed=0), of(1.0).bind(2, seed=0, cells=mixed(5))):
        with pytest.raises(tf.InputError, match="does not grow as the recording did"):
            tf.Replay(changed, recording)


def test_replicates_of_a_search_differ_by_their_founders():
    """The share of strain 1 among cells that do not divide is that of their founders."""

    def few(seed):
        return tf.inoculum(4, RADIUS, types={0: 1.0}, seed=seed)

    def share(seed):
        kinds = np.random.default_rng(seed).integers(0, 2, 4)
        cells = few(seed)
        return tf.Cells(cells.position, cells.axis, extra={"lit": kinds.astype(float)})

    def family(rate):
        return tf.Scene(
            tf.Growth(rate=rate), tf.Division(length=4.0), tf.Mechanics(dim=2), founders=share
        )

    search = Search(
        family, [Parameter("rate", 0.5, 2.0)], OnFraction("lit", 0.5, 0.5), cells=6, replicates=4
    )
    best = search.run(colonies=8, progress=False)
    ends = [c.state for c in best.colonies()]
    lit = torch.cat([s.groups.sum(s.lit) / s.counts for s in ends])
    assert len(lit) > 1 and len(set(lit.tolist())) > 1


@pytest.mark.parametrize(
    ("founders", "said"),
    [
        (5, r"Scene.founders = 5 .*Cells, or a function from a seed to Cells"),
        (lambda seed: seed, r"founders\(0\) = 0 .*must be Cells"),
        (lambda seed: tf.inoculum(2, 9.0, colonies=2, seed=seed), r"founders\(0\).*of one colony"),
    ],
)
def test_what_is_refused(founders, said):
    with pytest.raises(tf.InputError, match=said):
        scene(founders)


def test_all_have_the_same_columns():
    def odd(seed):
        return tf.inoculum(2, 9.0, seed=seed) if seed == 0 else mixed(seed)

    with pytest.raises(tf.InputError, match=r"columns cell_type, position; founders\(0\) gave"):
        scene(odd).bind(2)


def test_a_gradient_that_founders_lose_is_warned_of():
    place = torch.zeros(1, 2, requires_grad=True)
    with pytest.warns(UserWarning, match=r"Cells\.position requires a gradient.*first state"):
        cells = tf.Cells(place, [[1.0, 0.0]])
    state = tf.Scene(tf.Growth(rate=1.0), founders=cells, dim=2).bind().start()
    assert state.replace(position=place.double()).position.requires_grad
    with pytest.warns(UserWarning, match=r"Cells\.length requires a gradient"):
        cells = tf.Cells([[0.0, 0.0]], [[1.0, 0.0]], length=[torch.tensor(3.0, requires_grad=True)])
    assert cells.length.tolist() == [3.0]


def test_columns_of_nearly_the_name_of_a_species_are_told():
    circuit = tf.Circuit(lambda u, s, p, cell: {"gfp": 1.0 - u.gfp}, species="gfp")

    def bound(name):
        cells = tf.Cells([[0.0, 0.0]], [[1.0, 0.0]], 2.0, extra={name: [2.0]})
        return tf.Scene(circuit, tf.Growth(rate=1.0), founders=cells, dim=2).bind()

    with pytest.warns(UserWarning, match="a column 'GFP', and the scene has 'gfp': should they"):
        bound("GFP")
    assert float(bound("gfp").start().gfp[0]) == 2.0  # without a warning
    bound("age")
