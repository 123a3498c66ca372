"""Lysis: cells burst, the medium gets all that they release, and the lineage remembers them."""

from __future__ import annotations

import math

import pytest
import torch
from exchanging_cells import totals
from helpers import step

import torchfilm as tf

F32 = torch.float32
BOX = [[-20.0, -20.0], [20.0, 20.0]]
FOUR = tf.Cells([[6.0 * k - 9.0, 0.0] for k in range(4)], [[0.0, 1.0]] * 4, length=2.0)


def stays(u, s, p, cell):
    return {"toxin": 0.0 * u.toxin}


def makes(u, s, p, cell):
    return {"toxin": p.k + 0.0 * u.toxin}


def leaks(u, s, p, cell):
    out = 2.0 * u.toxin
    return {"toxin": -out}, {"toxin": out * cell.volume}


def holding(rates=stays, amount=5.0, **given) -> tf.Circuit:
    return tf.Circuit(rates, species="toxin", initial={"toxin": amount}, **given)


def medium(*signals: str, **given) -> tf.Medium:
    named = {n: tf.Signal(diffusion=50.0) for n in signals}
    return tf.Medium(**named, **({"box": BOX, "spacing": 2.0, "depth": 1.0} | given))


def lost(state: tf.State) -> list[int]:
    """The cells that burst in the last step."""
    return [k for note in state.ended if note.fate == "lysed" for k in note.uid.tolist()]


# --- which cells burst -------------------------------------------------------------------


def test_cells_burst_in_the_step_in_which_they_exceed_the_bound(device, dtype):
    scene = tf.Scene(
        holding(makes, 0.0, k=1.0, dilution=False),
        tf.Lysis(when="toxin", above={0: 0.35, 1: 9.0}),
        founders=tf.Cells(FOUR.position, FOUR.axis, cell_type=[0, 1, 0, 1]), dt=0.1,
    )  # fmt: skip
    state = scene.bind(2, device=device, dtype=dtype).start()
    for number in range(1, 6):
        state = step(scene, state, 0.1)
        assert state.counts.tolist() == ([4, 4] if number < 4 else [2, 2])
        assert lost(state) == ([0, 2, 0, 2] if number == 4 else [])
    assert state.cell_type.tolist() == [1, 1, 1, 1]


def test_a_rule_chooses_cells_too():
    def choose(cells):
        cells.lysing = ((cells.uid == 2) & (cells.time > 0.15)).float()

    scene = tf.Scene(
        tf.Rules(choose, variables={"lysing": 0.0}), tf.Lysis(when="lysing"), founders=FOUR, dim=2
    )
    course = [lost(state) for state in tf.simulate(scene, until=0.5, dt=0.1)]
    assert [k for k, gone in enumerate(course) if gone] == [2] and course[2] == [2]


def test_cells_burst_at_their_rate():
    """Of n cells n·exp(−rate·t) are left, within five standard deviations; type 1 has rate 0."""
    many = tf.Cells([[9.0 * k, 0.0] for k in range(5000)], [[0.0, 1.0]] * 5000,
                    cell_type=[0] * 4000 + [1] * 1000)  # fmt: skip
    scene = tf.Scene(tf.Lysis(rate={0: 0.7, 1: 0.0}), founders=many, dim=2)
    *_, state = tf.simulate(scene, until=2.0, dt=0.1, seed=5)
    left = math.exp(-1.4)
    kinds = state.cell_type.bincount().tolist()
    assert kinds[1] == 1000
    assert kinds[0] == pytest.approx(4000 * left, abs=5 * (4000 * left * (1 - left)) ** 0.5)


def test_a_rate_holds_only_above_the_bound():
    scene = tf.Scene(
        holding(dilution=False, amount={0: 1.0, 1: 3.0}),
        tf.Lysis(when="toxin", above=2.0, rate=1e6),
        founders=tf.Cells(FOUR.position, FOUR.axis, cell_type=[0, 1, 1, 0]), dim=2,
    )  # fmt: skip
    assert step(scene, scene.bind().start(), 0.1).uid.tolist() == [0, 3]


def test_several_draw_each_for_itself():
    """Two hazards add up, and each gets its share of the cells."""
    many = tf.Cells([[9.0 * k, 0.0] for k in range(4000)], [[0.0, 1.0]] * 4000)
    scene = tf.Scene(
        tf.Lysis(rate=0.4, releases={"a": 1.0}), tf.Lysis(rate=0.2, releases={"b": 1.0}),
        tf.Medium(
            a=tf.Signal(diffusion=0.0), b=tf.Signal(diffusion=0.0),
            box=[[-50.0, -50.0], [36050.0, 50.0]], spacing=50.0, depth=1.0,
        ),
        founders=many,
    )  # fmt: skip
    burst = 0
    for state in tf.simulate(scene, until=2.0, dt=0.05, seed=5):
        report = state.reports.get("lysis")
        burst += 0 if report is None else int(report.burst)
    left, gone = math.exp(-1.2), 1 - math.exp(-1.2)
    deviation = (4000 * left * gone) ** 0.5
    assert state.cells == pytest.approx(4000 * left, abs=5 * deviation)
    assert burst == 4000 - state.cells
    a, b = (float(totals(state, n, inside=False)) for n in "ab")
    assert a + b == pytest.approx(burst, rel=1e-4)
    # of the second the later draws are lost to the first of the same step: 1 % of them
    assert b / burst == pytest.approx(1 / 3, abs=0.01 + 5 * (2 / 9 / burst) ** 0.5)


def test_a_schedule_of_the_rate():
    pulse = tf.Schedule({0: 0.0, 0.2: 1e6, 0.3: 0.0})
    scene = tf.Scene(tf.Lysis(rate=pulse), founders=FOUR, dim=2)
    course = [state.cells for state in tf.simulate(scene, until=0.5, dt=0.1)]
    assert course == [4, 4, 0, 0, 0]
    with pytest.warns(UserWarning, match=r"Lysis\.rate has the value of 0\.2 h for 0\.1 h, less"):
        for _ in tf.simulate(scene, until=0.3, dt=0.15):
            pass


def test_a_factor_multiplies_the_rate():
    def choose(cells):
        cells.weak = (cells.uid % 2).float()

    many = tf.Cells([[9.0 * k, 0.0] for k in range(4000)], [[0.0, 1.0]] * 4000)
    scene = tf.Scene(
        tf.Rules(choose, variables={"weak": 0.0}), tf.Lysis(rate=0.7, factor="weak"),
        founders=many, dim=2,
    )  # fmt: skip
    *_, state = tf.simulate(scene, until=2.0, dt=0.1, seed=5)
    odd, left = int((state.uid % 2).sum()), math.exp(-1.4)
    assert state.cells - odd == 2000
    assert odd == pytest.approx(2000 * left, abs=5 * (2000 * left * (1 - left)) ** 0.5)


@pytest.mark.parametrize("dt", [0.05, 0.2])
def test_cells_die_by_what_they_meet_in_the_whole_step(dt, device, dtype):
    """A drug that decays by itself at 6/h kills at the rate 4·drug: whatever the step, a cell lives
    with exp(−∫ 4·drug dt). The rate as a step begins would let 0.03 % live where 27 % do (0.2 h).
    """

    def kills(u, s, p, cell):
        return {"drug": -6.0 * u.drug, "dying": 4.0 * u.drug}

    many = tf.Cells([[9.0 * k, 0.0] for k in range(4000)], [[0.0, 1.0]] * 4000)
    scene = tf.Scene(
        tf.Circuit(
            kills, species=["drug", "dying"], initial={"drug": 2.0}, rtol=1e-6, dilution=False
        ),
        tf.Lysis(hazard="dying"), founders=many, dim=2,
    )  # fmt: skip
    state = scene.bind(device=device, dtype=dtype).start(seed=2)
    for number in range(1, round(1.0 / dt) + 1):
        state = step(scene, state, dt)
        assert not state.dying.any()
        left = math.exp(-4.0 * 2.0 * (1 - math.exp(-6.0 * number * dt)) / 6.0)
        assert state.cells == pytest.approx(4000 * left, abs=5 * (4000 * left * (1 - left)) ** 0.5)


def test_a_hazard_that_is_no_number_is_a_failure():
    def nothing(cells):
        cells.dying = cells.dying / 0.0

    scene = tf.Scene(
        tf.Rules(nothing, variables={"dying": 0.0}), tf.Lysis(hazard="dying"), founders=FOUR, dim=2
    )
    with pytest.raises(tf.SimulationError, match="dying"):
        next(iter(tf.simulate(scene, until=0.2)))


@pytest.mark.parametrize("when", ["length", "volume"])
def test_large_cells_burst(when):
    cells = tf.Cells(FOUR.position, FOUR.axis, length=[1.0, 2.0, 3.0, 4.0])
    above = 2.5 if when == "length" else 2.5 * math.pi * 0.25 + 4 / 3 * math.pi * 0.125
    scene = tf.Scene(tf.Lysis(when, above=above), founders=cells, dim=2)
    assert step(scene, scene.bind().start(), 0.1).uid.tolist() == [0, 1]


def test_a_level_that_is_no_number_is_a_failure():
    def lose(cells):
        cells.a = torch.where(cells.colony == 1, math.nan, cells.a)

    scene = tf.Scene(tf.Rules(lose, variables={"a": 0.0}), tf.Lysis("a"), founders=FOUR, dim=2)
    with pytest.raises(tf.SimulationError, match=r"colony 1 .*: a, which decides which"):
        for _ in tf.simulate(scene, until=0.2, colonies=2):
            pass


def test_what_is_no_number_is_named_by_each():
    def lose(cells):
        cells.a = torch.where(cells.colony == 0, math.nan, cells.a)
        cells.b = torch.where(cells.colony == 1, math.nan, cells.b)

    scene = tf.Scene(
        tf.Rules(lose, variables={"a": 0.0, "b": 0.0}), tf.Lysis("a"), tf.Lysis("b"),
        founders=FOUR, dim=2,
    )  # fmt: skip
    with pytest.raises(tf.SimulationError, match=r"(?s)colony 0 .*: a, which.*colony 1 .*: b, wh"):
        list(tf.simulate(scene, until=0.2, colonies=2))


def test_many_species_are_summed_alike_in_any_batch():
    names = tuple("abcdefgh")
    scene = tf.Scene(
        tf.Circuit(
            lambda u, s, p, cell: {n: 0.0 * u[n] for n in names}, species=names,
            initial={n: tf.Uniform(0.0, 1.0) for n in names},
        ),
        tf.Lysis(rate=1e9, releases={"all": names}), medium("all"), founders=FOUR,
    )  # fmt: skip
    five = step(scene, scene.bind(5).start(), 0.1)
    one = step(scene, scene.bind(streams=[3]).start(), 0.1)
    assert torch.equal(five.select([3]).signals["all"], one.signals["all"])


def test_the_report_has_every_signal_in_every_step():
    scene = tf.Scene(tf.Lysis(rate=0.0, releases={"a": 1.0}), medium("a"), founders=FOUR)
    report = step(scene, scene.bind(2).start(), 0.1).reports["lysis"]
    assert report.burst.tolist() == [0, 0] and report.released["a"].tolist() == [0.0, 0.0]


def test_the_report_has_what_several_release_to_one_signal():
    scene = tf.Scene(
        tf.Lysis("length", above=2.5, releases={"a": 3.0}),
        tf.Lysis("length", above=1.5, releases={"a": 5.0}), medium("a"),
        founders=tf.Cells(FOUR.position, FOUR.axis, length=[1.0, 2.0, 3.0, 4.0]),
    )  # fmt: skip
    state = step(scene, scene.bind(2).start(), 0.1)
    found, report = totals(state, "a", inside=False), state.reports["lysis"]
    assert report.burst.tolist() == [3, 3] and report.released["a"].tolist() == [11.0, 11.0]
    assert found.tolist() == pytest.approx([11.0, 11.0], rel=1e-5)


def test_who_bursts_does_not_depend_on_the_batch(tmp_path):
    scene = tf.Scene(
        tf.Growth(rate=1.0), tf.Division(length=4.0), tf.Mechanics(dim=2), holding(leaks),
        tf.Lysis(rate=0.5, releases={"toxin": "toxin"}), medium("toxin"), founders=FOUR, dt=0.05,
    )  # fmt: skip
    *_, both = tf.simulate(scene, colonies=3, until=2.0, seed=2)
    *_, alone = tf.simulate(scene, streams=[2], until=2.0, seed=2)
    *_, half = tf.simulate(scene, streams=[2], until=1.0, seed=2)
    *_, again = tf.simulate(scene, half, until=2.0)
    own = both.select([2])
    for other in (alone, again):
        assert torch.equal(own.uid, other.uid) and torch.equal(own.position, other.position)
        assert torch.equal(own.signals["toxin"], other.signals["toxin"])


# --- what they release -------------------------------------------------------------------


@pytest.mark.parametrize("apart", [5.0, 30.0])  # 30: two of three cells are beyond the box
@pytest.mark.parametrize("exchange", ["turns", "together"])
@pytest.mark.parametrize("rates", [stays, leaks])
def test_what_cells_release_is_found_outside(rates, exchange, apart, device, dtype):
    """Cells that leak, grow, divide and burst: nothing is lost, in a medium or a reservoir."""
    cells = tf.Cells([[apart * k, 0.0] for k in range(-1, 2)], [[0.0, 1.0]] * 3)
    scene = tf.Scene(
        tf.Growth(rate=1.0), tf.Division(length=4.0, conserves="volume"), tf.Mechanics(dim=2),
        holding(rates, daughters="amount"), tf.Lysis(rate=1.0, releases={"toxin": "toxin"}),
        medium("toxin", exchange=exchange, outside="reservoir"), founders=cells, dt=0.05,
    )  # fmt: skip
    state = scene.bind(3, seed=1, device=device, dtype=dtype).start()
    whole, burst = totals(state, "toxin").tolist(), 0
    for _ in range(30):
        state = step(scene, state, 0.05)
        burst += len(lost(state))
    assert burst > 5 and state.cells
    rounding = 3e-5 if dtype is F32 else 1e-12
    assert totals(state, "toxin").tolist() == pytest.approx(whole, rel=rounding)
    assert bool((state.fields["toxin_reservoir"] > 0).any()) == (apart > 20)


def test_volumes_amounts_and_several_species(device, dtype):
    def two(u, s, p, cell):
        return {"a": 0.0 * u.a, "b": 0.0 * u.b}

    scene = tf.Scene(
        tf.Circuit(two, species=("a", "b"), initial={"a": 1.0, "b": 2.0}),
        tf.Lysis(
            when="b",
            releases={"both": ("a", "b"), "debris": "volume", "phage": {0: 100.0, 1: 30.0}},
        ),
        medium("both", "debris", "phage"),
        founders=tf.Cells(FOUR.position, FOUR.axis, length=2.0, cell_type=[0, 0, 0, 1]),
    )  # fmt: skip
    start = scene.bind(2, device=device, dtype=dtype).start()
    volume = float(start.volume[:4].double().sum())
    state = step(scene, start, 0.1)
    assert state.cells == 0
    for signal, amount in (("both", 3 * volume), ("debris", volume), ("phage", 330.0)):
        found = totals(state, signal, inside=False)
        assert found.tolist() == pytest.approx([amount] * 2, rel=1e-6)


def test_how_much_of_what_a_cell_holds_is_released(device, dtype):
    """A number, one per type, and a distribution drawn at birth."""
    given = {"volume": {0: 2.0, 1: 0.5}, "toxin": 0.25, "store": tf.Uniform(1.0, 2.0)}
    scene = tf.Scene(
        holding(amount=4.0), tf.Rules(lambda c: None, variables={"store": 3.0}),
        tf.Lysis(when="toxin", releases={"food": given}), medium("food", "toxin"),
        founders=tf.Cells(FOUR.position, FOUR.axis, length=2.0, cell_type=[0, 0, 0, 1]),
    )  # fmt: skip
    start = scene.bind(2, device=device, dtype=dtype).start()
    volume = float(start.volume[0].double())
    drawn = start.groups.sum(start.fields["lysis_releases_food_store"].double())
    wanted = 6.5 * volume + 0.25 * 4.0 * 4 * volume + 3.0 * drawn
    found = totals(step(scene, start, 0.1), "food", inside=False)
    assert found.tolist() == pytest.approx(wanted.tolist(), rel=1e-6)


def test_variables_are_amounts_and_bursts_are_drawn():
    """A variable of rules is an amount; a drawn one is each cell's own, and kept from its birth."""
    cells = tf.Cells(FOUR.position, FOUR.axis, extra={"phages": [5.0, 6.0, 7.0, 8.0]})
    scene = tf.Scene(
        tf.Rules(lambda c: None, variables={"phages": 0.0}),
        tf.Lysis("phages", releases={"a": "phages", "b": tf.Uniform(50.0, 150.0)}),
        medium("a", "b"), founders=cells,
    )  # fmt: skip
    start = scene.bind(3, dtype=torch.float64).start()
    drawn = start.groups.sum(start.fields["lysis_releases_b"])
    state = step(scene, start, 0.1)
    assert totals(state, "a", inside=False).tolist() == pytest.approx([26.0] * 3)
    assert totals(state, "b", inside=False).tolist() == pytest.approx(drawn.tolist())
    assert len(set(drawn.tolist())) == 3
    report = state.reports["lysis"]
    assert report.burst.tolist() == [4] * 3
    assert report.released["b"].tolist() == pytest.approx(drawn.tolist())


@pytest.mark.parametrize("many", [[1.0, 2.0], torch.tensor([1.0, 2.0])])
def test_amounts_by_colony(many):
    scene = tf.Scene(tf.Lysis(rate=1e9, releases={"a": many}), medium("a"), founders=FOUR)
    state = step(scene, scene.bind(2).start(), 0.1)
    assert totals(state, "a", inside=False).tolist() == pytest.approx([4.0, 8.0])


def test_what_is_released_lands_about_the_cell():
    scene = tf.Scene(
        holding(), tf.Lysis(when="toxin", releases={"toxin": "toxin"}), medium("toxin"),
        founders=tf.Cells([[5.0, -7.0]], [[1.0, 0.0]]),
    )  # fmt: skip
    state = step(scene, scene.bind().start(), 0.1)
    grid, found = state.layout.grid, state.signals["toxin"].double()
    near = (found[:, None] * grid.centres()[:, :2].double()).sum(0) / found.sum()
    assert near.tolist() == pytest.approx([5.0, -7.0], abs=1e-5)


def test_corpses_feed_the_others():
    """Biomass = what was released · yield: no more and no less."""
    scene = tf.Scene(
        tf.Growth(), tf.Monod("debris", rate=1.0, half=0.1, growth_yield=0.5), tf.Mechanics(dim=2),
        tf.Rules(lambda c: setattr(c, "dying", (c.uid < 2).float()), variables={"dying": 0.0}),
        tf.Lysis(when="dying", releases={"debris": "volume"}), medium("debris"), founders=FOUR,
    )  # fmt: skip
    first = scene.bind(dtype=torch.float64).start()
    *_, state = tf.simulate(scene, until=6.0, dtype=torch.float64)
    dead = float(first.volume[:2].sum())
    left = float(totals(state, "debris", inside=False))
    gained = float(state.volume.sum() - first.volume[2:].sum())
    assert gained == pytest.approx(0.5 * (dead - left), rel=1e-9) and gained > 0.1


def test_gradients_go_from_the_medium_to_what_cells_held():
    def run(amount):
        scene = tf.Scene(
            holding(amount=amount), tf.Lysis(when="toxin", releases={"toxin": "toxin"}),
            medium("toxin"), founders=FOUR,
        )  # fmt: skip
        model = scene.bind(1, dtype=torch.float64)
        return totals(model.step(model.start(), 0.1), "toxin").sum()

    amount = torch.tensor([5.0], dtype=torch.float64, requires_grad=True)
    found = run(amount)
    (slope,) = torch.autograd.grad(found, amount)
    assert float(slope) == pytest.approx(float(found.detach()) / 5.0, rel=1e-9)


# --- what goes with it -------------------------------------------------------------------


def test_the_lineage_and_the_explanation_name_it(tmp_path):
    def two(u, s, p, cell):
        return {"a": 0.0 * u.a, "b": 0.0 * u.b}

    scene = tf.Scene(
        tf.Circuit(two, species=("a", "b"), initial={"a": 1.0}),
        tf.Lysis(when="a", releases={"a": "a"}), medium("a"), founders=FOUR,
    )  # fmt: skip
    for _ in tf.simulate(scene, until=0.1, dt=0.05, record=tmp_path / "run.h5"):
        pass
    with tf.Results(tmp_path / "run.h5") as results:
        assert list(results.lineage().fate) == ["lysed"] * 4
    text = tf.explain(scene)
    assert "in which a exceeds its bound" in text and "a gets a" in text
    assert "lost with the cells: b" in text


def test_a_search_grows_each_design_anew():
    scene = tf.Scene(
        tf.Growth(rate=1.0), tf.Division(length=4.0), tf.Mechanics(dim=2),
        holding(makes, 0.0, k=1.0), tf.Lysis(when="toxin", above=2.0),
    )  # fmt: skip
    model = scene.bind(2)
    assert {scene.effects[k].title for k in model.recorded} >= {"lysis", "circuit"}


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({}, "none of `when`, `rate` and `hazard`"),
        ({"hazard": "toxin", "rate": 1.0}, "Lysis.rate = 1.0 is not allowed: it must be left out"),
        ({"hazard": "a b"}, "Lysis.hazard = 'a b' is not allowed: it must be the name of a spec"),
        ({"when": "a", "factor": "b"}, "Lysis.factor = 'b' .* given with rate, which it mult"),
        ({"rate": 1.0, "above": 3.0}, "Lysis.above = 3.0 is not allowed: it must be given with"),
        ({"when": "a", "releases": {"a": ("b", "b")}}, "a tuple of different names"),
        ({"when": "radius"}, "Lysis.when = 'radius' .*of a cell's shape"),
        ({"when": "a", "releases": {"a": "length"}}, "of a cell's shape, `when` knows length"),
        ({"when": "a b"}, "Lysis.when = 'a b' is not allowed: it must be the name of a species"),
        ({"rate": -1.0}, "Lysis.rate"),
        ({"when": "toxin", "releases": ["toxin"]}, "a dict of what goes to each signal"),
        ({"when": "toxin", "releases": {"a b": "toxin"}}, "keys that name signals"),
        ({"when": "toxin", "releases": {"toxin": ()}}, r"releases\['toxin'\] = \(\) is not"),
        (
            {"when": "toxin", "releases": {"toxin": "2 + 2"}},
            "a dict of how much of each, or an amount",
        ),
        ({"when": "toxin", "releases": {"toxin": -5.0}}, r"releases\['toxin'\]"),
        ({"when": "toxin", "releases": {"toxin": {"toxin": -1.0}}}, r"\['toxin'\]\['toxin'\] = -1"),
        ({"when": "toxin", "releases": {"toxin": {"length": 1.0}}}, "of a cell's shape"),
        (
            {"when": "toxin", "releases": {"toxin": {"a": 1.0, 0: 1.0}}},
            "a dict of how much of each",
        ),
    ],
)
def test_bad_input(given, words):
    with pytest.raises(tf.InputError, match=words):
        tf.Lysis(**given)


@pytest.mark.parametrize(
    ("given", "words"),
    [
        (
            {"when": "toxn"},
            r"lysis needs the field 'toxn'.*Did you mean 'toxin'.*variables=\{'toxn': 0.0\}",
        ),
        ({"rate": 1.0, "factor": "toxn"}, "lysis needs the field 'toxn'.*Did you mean 'toxin'"),
        ({"hazard": "growth_rate"}, "only for it. growth_rate is in 1/h, and would be 0"),
        ({"hazard": "toxn"}, "lysis needs the field 'toxn'.*Did you mean 'toxin'"),
        ({"when": "toxin", "releases": {"colicin": "toxin"}}, "the Medium has toxin, ahl"),
        ({"when": "toxin", "releases": {"toxin": "colicin"}}, "lysis needs the field 'colicin'"),
        ({"when": "age"}, "variable of rules"),
        ({"when": "out"}, "variable of rules"),
        ({"when": "ahl"}, r"'ahl' is a signal: let a rule .* cells.signals.ahl"),
        ({"when": "displacement", "releases": {}}, "one number for each cell"),
    ],
)
def test_names_that_a_scene_lacks(given, words):
    with pytest.raises(tf.InputError, match=words):
        tf.Scene(
            holding(), tf.Lysis(**given), medium("toxin", "ahl"), tf.Growth(rate=1.0),
            tf.Mechanics(dim=2), founders=FOUR,
        ).bind()  # fmt: skip


def test_below_zero_nothing_is_released():
    def fall(cells):
        cells.store = cells.store - 1.0

    scene = tf.Scene(
        tf.Rules(fall, variables={"store": 0.5}), tf.Lysis(rate=1.0, releases={"toxin": "store"}),
        medium("toxin"), founders=FOUR, dim=2,
    )  # fmt: skip
    with pytest.raises(tf.SimulationError, match=r"store of cell 0 .* must be at least 0"):
        for _ in tf.simulate(scene, until=0.2):
            pass
