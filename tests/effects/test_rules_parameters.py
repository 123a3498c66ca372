"""Constants of rules: what they find as `cells.p`."""

import math

import pytest
import torch

import torchfilm as tf
from design import OnFraction, Parameter, Search


def founders(count=2) -> tf.Cells:
    return tf.Cells(
        [[9.0 * k, 0.0] for k in range(count)], [[1.0, 0.0]] * count, 2.0,
        cell_type=[k % 2 for k in range(count)],
    )  # fmt: skip


def adds(cells):
    cells.sum = cells.sum + cells.p.k * cells.dt


def end(rule, until=1.0, colonies=2, variables=None, founders=founders, **parameters) -> tf.State:
    rules = tf.Rules(rule, variables=variables or {"sum": 0.0}, parameters=parameters)
    scene = tf.Scene(rules, founders=founders(), dim=2, dt=0.05)
    *_, state = tf.simulate(scene, until=until, colonies=colonies)
    return state


@pytest.mark.parametrize(
    ("value", "sums"),
    [
        (2.0, [2.0, 2.0, 2.0, 2.0]),
        (tf.PerColony([1.0, 3.0]), [1.0, 1.0, 3.0, 3.0]),
        ({0: 1.0, 1: 5.0}, [1.0, 5.0, 1.0, 5.0]),
        ({0: torch.tensor([1.0, 2.0]), 1: 0.0}, [1.0, 0.0, 2.0, 0.0]),
        (tf.Schedule({0: 4.0, 0.25: 0.0}), [1.0] * 4),
    ],
)
def test_a_rule_reads_a_value_for_each_cell(value, sums):
    assert end(adds, k=value).sum.tolist() == pytest.approx(sums, rel=1e-5)


def test_one_that_is_drawn_is_kept_from_birth():
    state = end(adds, k=tf.Uniform(1.0, 2.0))
    assert torch.allclose(state.sum, state.fields["rules_k"])
    assert len(set(state.sum.tolist())) == 4


def test_one_cell_at_a_time_finds_its_own():
    def slowly(cells):
        for cell in cells:
            cell.sum = cell.sum + cell.p.k * cells.dt

    assert end(slowly, k={0: 1.0, 1: 5.0}).sum.tolist() == pytest.approx([1.0, 5.0, 1.0, 5.0])


def test_a_rule_at_division_finds_them():
    def divide(parent, daughter1, daughter2):
        daughter1.mark = parent.p.mark + daughter1.p.mark
        daughter2.mark = 0.0

    scene = tf.Scene(
        tf.Growth(rate=1.0), tf.Division(length=3.0), tf.Mechanics(dim=2),
        tf.Rules(divide=divide, variables={"mark": 0.0}, parameters={"mark": {0: 1.0, 1: 4.0}}),
        founders=founders(),
    )  # fmt: skip
    *_, state = tf.simulate(scene, cells=4)
    for kind, mark in ((0, 2.0), (1, 8.0)):
        mine = state.mark[state.cell_type == kind]
        assert set(mine.tolist()) == {0.0, mark}


def test_a_search_finds_a_rate_of_death():
    """Of cells that do not grow exp(−k t) are left."""

    def die(cells):
        cells.remove_flag = cells.chance(1 - torch.exp(-cells.p.k * cells.dt))

    def family(k):
        return tf.Scene(
            tf.Rules(die, parameters={"k": k}), tf.Mechanics(dim=2),
            founders=tf.inoculum(400, 150.0), dt=0.1,
        )  # fmt: skip

    *_, state = tf.simulate(family(torch.tensor([0.5, 2.0])), until=1.0, colonies=2)
    for count, k in zip(state.counts.tolist(), (0.5, 2.0), strict=True):
        left = math.exp(-k)
        assert count == pytest.approx(400 * left, abs=4 * math.sqrt(400 * left * (1 - left)))

    def lit(cells):
        cells.lit = torch.where(cells.uid % 2 < 2 * cells.p.level, 1.0, 0.0)

    def scene(level):
        return tf.Scene(
            tf.Rules(lit, variables={"lit": 0.0}, parameters={"level": level}),
            tf.Growth(rate=1.0), tf.Division(length=3.0), tf.Mechanics(dim=2),
        )  # fmt: skip

    # half of the cells up to 1/2, all above
    search = Search(scene, [Parameter("level", 0.0, 1.0)], OnFraction("lit", 0.5, 0.5), cells=12)
    assert 0.0 < float(search.run(colonies=16, progress=False).values["level"]) <= 0.5


def test_they_count_for_the_scene():
    rules = [tf.Rules(adds, variables={"sum": 0.0}, parameters={"k": k}) for k in (1.0, 1.0, 2.0)]
    assert rules[0] == rules[1] and rules[0] != rules[2]


def of(rule, more=(), **parameters):
    rules = tf.Rules(rule, variables={"sum": 0.0}, parameters=parameters)
    return tf.Scene(rules, *more, founders=founders(), dim=2)


def wrong_name(cells):
    cells.sum = cells.p.kk


def written(cells):
    cells.p.k = 2.0


PROTEIN = tf.Circuit(lambda u, s, p, cell: {"p": -u.p}, species="p")


@pytest.mark.parametrize(
    ("build", "said"),
    [
        (lambda: tf.Rules(adds, parameters=["k"]), r"Rules.parameters = \['k'\] .*a dict"),
        (lambda: tf.Rules(adds, parameters={"k k": 1.0}), r"Rules.parameters = 'k k' .*a name"),
        (lambda: tf.Rules(adds, parameters={"k": "a"}), r"Rules.k = 'a' .*must be a number"),
        (lambda: of(wrong_name, k=1.0).bind(), r"cells.p has no 'kk'.*k"),
        (lambda: of(written, k=1.0).bind(), r"cells.p.k can only be read: constants stay"),
        (lambda: of(adds).bind(), r"cells have no 'p'"),
        (lambda: of(adds, k={0: 1.0}).bind(), r"Rules.k has values for the cell types 0"),
        (lambda: of(adds, k=[1.0, 2.0, 3.0]).bind(2), r"3"),
        (lambda: of(adds, (PROTEIN,), k=1.0).bind(), r"cells have a field 'p': rename"),
    ],
)
def test_what_is_refused(build, said):
    with pytest.raises(tf.InputError, match=said):
        build()


# --- variables alone ------------------------------------------------------------------------------


def lit(rules) -> tf.Scene:
    rates = lambda u, s, p, cell: {"gfp": 2.0 * cell.light - u.gfp}
    return tf.Scene(
        rules, tf.Growth(rate=1.0), tf.Division(length=3.5), tf.Mechanics(dim=2),
        tf.Circuit(rates, species="gfp"), dt=0.1,
    )  # fmt: skip


def shone_on(step, state) -> tf.State:
    """A loop of control, from outside."""
    for _ in range(20):
        level = state.groups.sum(state.gfp) / state.counts
        state = step(state.with_fields(light=(1.0 - level).clamp(min=0.0)[state.colony]))
    return state


def test_variables_without_functions_are_set_from_outside():
    """They are those of a rule that does nothing, and follow recorded growth."""
    scene, empty = (
        lit(tf.Rules(variables={"light": 0.5})),
        tf.Rules(lambda cells: None, variables={"light": 0.5}),
    )
    model, other = scene.bind(2), lit(empty).bind(2)
    assert (model.start().light == 0.5).all()
    found = shone_on(lambda s: model.step(s, dt=0.1), model.start())
    plain = shone_on(lambda s: other.step(s, dt=0.1), other.start())
    assert found.cells > 2 and (found.gfp > 0.1).all() and torch.equal(found.gfp, plain.gfp)
    assert model.why_not_replayable == "" and "rules may read" in other.why_not_replayable
    replay = tf.Replay(model, tf.GrowthRecording(scene, streams=range(2), seed=0))
    again = shone_on(replay.step, model.start())
    assert torch.equal(again.gfp, found.gfp) and torch.equal(again.uid, found.uid)
    assert "your own Python" not in tf.explain(scene, seconds=0)


def test_rules_without_functions_and_variables_do_nothing():
    with pytest.raises(tf.InputError, match=r"neither update nor divide.*or variables"):
        tf.Rules(parameters={"k": 1.0})
    with pytest.raises(tf.InputError, match=r"extra=\{'plasmids': \{0: 4, 1: 0\}\}"):
        tf.Rules(variables={"plasmids": {0: 4, 1: 0}})
