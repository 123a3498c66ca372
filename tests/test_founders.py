"""Founders that are drawn for each colony."""

import numpy as np
import pytest
import torch

import torchfilm as tf
from design import OnFraction, Parameter, Search
from design.targets import Composition, Conditions

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
    assert other.draw.function is mixed and "6 founder(s), drawn for each colony" in other.headline
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

    with pytest.raises(tf.InputError, match=r"columns cell_type, position; those of colony 0"):
        scene(odd).bind(2)


def shared(seed, share, count=10):
    return tf.inoculum(round(count), RADIUS, types={0: 1 - share, 1: share}, seed=seed)


def strains(state: tf.State) -> list[tuple[int, int]]:
    """How many cells of each type each colony has."""
    kinds = [state.cell_type[state.colony == k] for k in range(state.colonies)]
    return [(int((kind == 0).sum()), int((kind == 1).sum())) for kind in kinds]


@pytest.mark.parametrize("form", [list, np.array, torch.tensor, lambda x: tf.PerColony(x)])
def test_they_may_differ_between_colonies(form):
    founders = tf.Founders(shared, share=form([0.0, 0.5, 1.0]), count=form([4, 8, 2]))
    first = scene(founders).bind().start()
    assert strains(first) == [(4, 0), (4, 4), (0, 2)]


def test_values_of_single_precision_are_those_that_were_typed():
    """So rows of tables can be selected by them."""
    for given in (torch.tensor([0.1, 0.9]), np.array([0.1, 0.9], np.float32)):
        (of_share,) = scene(tf.Founders(shared, share=given)).per_colony()
        assert of_share[0] == "Founders.share" and of_share[1].tolist() == [0.1, 0.9]


def test_texts_are_kept_in_results_and_name_colonies(tmp_path):
    """Through a resume, too, and beside numbers; in the order of the colonies of the run."""
    path = tmp_path / "run.h5"

    def made(seed, kind, size):
        return tf.inoculum({"few": 1, "many": 3}[kind], 5.0, seed=seed)

    values = {"kind": ["few", "many", "few"], "size": [1.0, 1.0, 2.0]}
    few_or_many = scene(tf.Founders(made, **values))
    start = few_or_many.bind(seed=1).start().select([2, 1, 0])
    state = tf.simulate(few_or_many, start, until=0.2, record=path).last()
    tf.simulate(few_or_many, state, until=0.4, record=tf.Recorder(path, few_or_many, append=True))
    with tf.Results(path) as results:
        kept = results.parameters()
        assert kept["Founders.kind"].tolist() == ["few", "many", "few"]
        assert kept["Founders.size"].tolist() == [2.0, 1.0, 1.0]
        table = results.table(-1)
        assert dict(zip(table["colony"].tolist(), table["kind"].tolist(), strict=True)) == {
            2: "few", 1: "many", 0: "few",
        }  # fmt: skip
        results.to_vtkhdf(tmp_path / "run.vtkhdf")
    figure = tf.pictures.time_course(path, conditions="kind").figure
    names = [text.get_text() for text in figure.axes[0].get_legend().texts]
    assert names == ["kind = few, mean of 2", "kind = many"]


def test_colonies_of_one_stream_differ_by_their_values_alone():
    def placed(seed, share):
        cells = tf.inoculum(4, RADIUS, seed=seed)
        return tf.Cells(cells.position, cells.axis, extra={"lit": np.full(4, share)})

    founders = tf.Founders(placed, share=[0.2, 0.8])
    first = scene(founders).bind(streams=[3, 3]).start()
    assert torch.equal(places(first, 0), places(first, 1))
    assert first.lit.tolist() == pytest.approx(4 * [0.2] + 4 * [0.8])
    alone = scene(tf.Founders(placed, share=0.8)).bind(1, streams=[3]).start()
    assert torch.equal(places(alone, 0), places(first, 1)) and torch.equal(alone.lit, first.lit[4:])


def test_values_for_all_colonies_leave_their_number_open():
    founders = tf.Founders(shared, share=0.25, count=4)
    assert strains(scene(founders).bind(2).start()) == [(3, 1), (3, 1)]
    assert scene(founders) == scene(tf.Founders(shared, share=0.25, count=4))
    assert scene(founders) != scene(tf.Founders(shared, share=0.5, count=4))


def test_their_numbers_are_kept_with_the_results(tmp_path):
    given = scene(tf.Founders(shared, share=[0.5, 0.25], count=4))
    for _ in tf.simulate(given, until=0.5, record=tmp_path / "run.h5"):
        pass
    with tf.Results(tmp_path / "run.h5") as results:
        table = results.table()
        state = results.state(given)
    assert all(table["share"] == np.where(table["colony"] == 0, 0.5, 0.25))
    *_, whole = tf.simulate(given, until=1.0)
    *_, end = tf.simulate(given, state, until=1.0)
    assert torch.equal(whole.position, end.position)


def test_what_colonies_began_with_stays_on_record(tmp_path):
    first, other = ([0.25, 0.5, x] for x in (0.75, 0.8))
    of = lambda shares: scene(tf.Founders(shared, share=shares, count=4))
    for _ in tf.simulate(of(first), until=0.1, record=tmp_path / "a.h5"):
        pass
    with tf.Results(tmp_path / "a.h5") as results:
        state = results.state(of(first))
    for _ in tf.simulate(
        of(other), state, until=0.2, record=tf.Recorder(tmp_path / "a.h5", of(other), append=True)
    ):
        pass
    with tf.Results(tmp_path / "a.h5") as results:
        assert set(results.table()["share"]) == {0.25, 0.5, 0.75}
    # founders in the place of others
    model = of(first).bind(cells=shared(0, 0.5))
    for _ in tf.simulate(model, until=0.1, record=tmp_path / "b.h5"):
        pass
    with tf.Results(tmp_path / "b.h5") as results:
        assert "share" not in results.table()


def test_a_search_varies_them():
    """Of cells that grow alike the composition at the end is that of the founders."""

    def family(share, count):
        return scene(tf.Founders(shared, share=share, count=count))

    spaces = [Parameter("share", 0.2, 0.9), Parameter("count", 6, 12)]
    search = Search(
        family, spaces, Composition({0: 0.3, 1: 0.7}), until=0.2, dt=0.1, replicates=2, seed=0
    )
    best = search.run(colonies=60, progress=False)
    assert best.values["share"] == pytest.approx(0.7, abs=0.1)
    assert "its founders differ between colonies" in best.table()
    ends = [c.state for c in best.colonies()]
    wanted = round(best.values["count"]), best.values["share"]
    assert all(sum(pair) == wanted[0] for s in ends for pair in strains(s))
    assert all(abs(two / (one + two) - wanted[1]) < 0.1 for s in ends for one, two in strains(s))


def test_conditions_set_them():
    """The share of strain 1 under each condition."""

    def family(count, share):
        return scene(tf.Founders(shared, share=share, count=count))

    both = Conditions(
        [({"share": 0.2}, Composition({1: 0.2})), ({"share": 0.8}, Composition({1: 0.8}))]
    )
    search = Search(family, [Parameter("count", 9.6, 10.4)], both, until=0.2, dt=0.1, replicates=1)
    best = search.run(colonies=4, progress=False)
    assert best.loss < 1e-3


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda: tf.Founders(shared, count=4), "a seed and of count.*missing.*'share'"),
        (lambda: tf.Founders(mixed, share=[0.5]), "a seed and of share"),
        (lambda: tf.Founders(tf.Cells), "must be Cells, or a function from a seed to Cells"),
        (lambda: tf.Founders(shared, share=[]), "Founders.share = .*a value for each colony"),
        (lambda: tf.Founders(shared, share=[[0.5]]), r"share\[0\] = .*one value for each.*tuple"),
        (lambda: tf.Founders(shared, share=[0.5, 0.2], count=[1, 2, 3]), "2 of share, 3 of count"),
        (
            lambda: tf.Founders(shared, share=torch.tensor([0.5], requires_grad=True)),
            "Founders.share = .*without gradients.*no derivatives",
        ),
        (
            lambda: scene(tf.Founders(shared, share=[0.5, 1.5])).bind(),
            r"types\[0\] = -0.5 .*share=1.5\), for colony 1",
        ),
        (
            lambda: scene(tf.Founders(shared, share=[0.5, 0.2])).bind(3),
            "2 values per colony of share'.*one value for each of the 3 colonies",
        ),
        (
            lambda: scene(tf.Founders(shared, share=[0.5, 0.2])).bind(
                state=scene().bind(3).start()
            ),
            "2 values per colony of share'.*one value for each of the 3 colonies",
        ),
        (
            lambda: tf.GrowthRecording(
                scene(tf.Founders(shared, share=[0.5, 0.2])), streams=range(2)
            ),
            "founders differ between colonies",
        ),
        (lambda: tf.inoculum([3, 4], RADIUS), r"count = \[3, 4\] .*tf\.Founders"),
        (lambda: scene(shared), "the seed of the colony.*tf.Founders"),
    ],
)
def test_what_values_of_founders_are_refused(make, said):
    with pytest.raises(tf.InputError, match=said):
        make()


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
