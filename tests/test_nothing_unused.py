"""Nothing that a user gives is silently unused, and nothing runs that cannot mean what it says."""

from __future__ import annotations

import inspect
import pickle
import warnings

import pytest

import torchfilm as tf


def made(u, s, p, cell):
    return {"m": p.strength - u.m}


def quiet(make):
    """What is made without a warning."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        return make()


def test_a_constant_that_no_rate_reads_is_warned_of():
    scene = tf.Scene(
        tf.Mechanics(dim=2), tf.Circuit(made, species=("m",), strength=1.0, leftover=3.0)
    )
    with pytest.warns(UserWarning, match=r"Circuit\.leftover is a constant that no rate") as told:
        scene.bind()
    assert [w.filename for w in told] == [__file__]
    quiet(
        lambda: tf.Scene(tf.Mechanics(dim=2), tf.Circuit(made, species=("m",), strength=1.0)).bind()
    )


def senses(u, s, p, cell):
    return {"m": s.ahl - u.m}


def gives(u, s, p, cell):
    return {"m": 1.0 - u.m}, {"ahl": u.m}


def with_medium(rates, *more, boundary=None, outside="error", **signal):
    box = {"box": ((-16, -16), (16, 16)), "spacing": 4.0, "boundary": boundary}
    medium = tf.Medium(ahl=tf.Signal(diffusion=10.0, **signal), outside=outside, **box)
    return tf.Scene(tf.Mechanics(dim=2), tf.Circuit(rates, species=("m",)), medium, *more)


def test_a_signal_that_stays_0_is_warned_of_at_the_users_line():
    with pytest.warns(UserWarning, match=r"'ahl' of the Medium is 0 and stays 0.*source=") as told:
        with_medium(senses).bind()
    assert [w.filename for w in told] == [__file__]
    with pytest.warns(UserWarning, match="stays 0"):  # whether or not anything reads it
        with_medium(lambda u, s, p, cell: {"m": 1.0 - u.m}).bind()


@pytest.mark.parametrize(
    "how",
    [
        {"source": 1.0},
        {"initial": 0.5},
        {"source": lambda places: places[:, 0].abs()},
        {"reservoir": 1.0, "outside": "reservoir"},
        {"boundary": tf.BoundaryConditions(x=tf.Dirichlet(1.0))},
        {"boundary": tf.BoundaryConditions(y=(tf.NoFlux(), tf.Open(2.0))), "flow": (0.0, -1.0)},
    ],
    ids=lambda how: next(iter(how)),
)
def test_a_signal_that_something_supplies_is_not(how):
    quiet(lambda: with_medium(senses, **how).bind())


def test_a_nutrient_that_nothing_supplies_is_warned_of():
    """Monod changes it, but only takes."""
    food = tf.Medium(food=tf.Signal(10.0), box=((-20, -20), (20, 20)), spacing=4.0)
    with pytest.warns(UserWarning, match="'food' of the Medium is 0 and stays 0"):
        tf.Scene(tf.Growth(), tf.Monod("food"), food, dim=2).bind()


def test_a_signal_that_cells_or_rules_may_give_is_not():
    quiet(lambda: with_medium(gives).bind())
    quiet(lambda: with_medium(senses, tf.Rules(lambda cells: None)).bind())


def test_rates_for_a_type_without_cells_are_warned_of():
    circuit = tf.Circuit({0: made, 7: made}, species=("m",), strength=1.0)
    parts = (tf.Mechanics(dim=2), circuit)
    with pytest.warns(UserWarning, match=r"cells of type 7, of which.*are of type 0\.") as told:
        tf.Scene(*parts).bind()
    assert [w.filename for w in told] == [__file__]

    def turned(cells):
        cells.cell_type = 7

    quiet(lambda: tf.Scene(*parts, tf.Rules(turned)).bind())
    both = tf.Cells([[0, 0], [5, 0]], [[1, 0], [1, 0]], cell_type=[0, 7])
    quiet(lambda: tf.Scene(*parts, founders=both).bind())


def test_a_misspelt_option_of_a_circuit_is_an_error():
    scene = tf.Scene(
        tf.Mechanics(dim=2), tf.Circuit(made, species=("m",), strength=1.0, initials=1.0)
    )
    with pytest.raises(tf.InputError, match=r"Circuit\.initials.*Did you mean the option initial"):
        scene.bind()


@pytest.mark.parametrize(
    "make, words",
    [
        (lambda: tf.Growth(rat=1.0), "Growth has no parameter 'rat'. Did you mean rate?"),
        (
            lambda: tf.Division(lenght=4.0),
            "Division has no parameter 'lenght'. Did you mean length?",
        ),
        (lambda: tf.Mechanics(dimension=2), "Mechanics has no parameter 'dimension'"),
        (
            lambda: tf.simulate(tf.scenes.microcolony(), untill=1.0),
            "simulate has no parameter 'untill'. Did you mean until?",
        ),
        (
            lambda: tf.Plane(z=0.0, facin="+z"),
            "Plane has no parameter 'facin'. Did you mean facing?",
        ),
        (lambda: tf.Sphere((0, 0), radious=1.0), "Sphere has no parameter 'radious'. Did you mean"),
        (lambda: tf.Box((0, 0), (1, 1), stifness=1.0), "Did you mean stiffness?"),
        (lambda: tf.Mechanics(unilateral=True), 'contacts="one-sided", the default'),
        (
            lambda: tf.Mechanics(gamma=10),
            "Mechanics has no parameter 'gamma'. Did you mean length_d",
        ),
        (lambda: tf.Signal(D=10.0), "Signal has no parameter 'D'. Did you mean diffusion?"),
        (lambda: tf.Cells([[0, 0]], celltype=[1]), "'celltype'. Did you mean cell_type?"),
        (lambda: tf.Cells([[0, 0]], angle=[0.3]), "Write axis=[[cos, sin], …], or Cells.from_tab"),
        (lambda: tf.Scene(tf.Growth(rate=1.0), dtt=0.1), "Scene has no parameter 'dtt'. Did you"),
        (lambda: tf.scenes.microcolony().bind(colonie=2), "Did you mean colonies?"),
        (lambda: tf.Uniform(low=1.0, hihg=2.0), "Uniform has no parameter 'hihg'. Did you mean h"),
        (lambda: tf.Dirichlet(valeu=1.0), "Dirichlet has no parameter 'valeu'. Did you mean value"),
        (lambda: tf.BoundaryConditions(xx=tf.Open()), "BoundaryConditions has no parameter 'xx'"),
        (lambda: tf.Settings(penalti=0.1), "Settings has no parameter 'penalti'. Did you mean pen"),
        (
            lambda: tf.Scene(effects=[tf.Growth(rate=1.0)]),
            "'effects'. Effects come first, without a name: (*effects, name=…). It has: *effects,",
        ),
        (
            lambda: tf.scenes.microcolony().replace(effects=[]),
            "'effects'. Effects come first, without a name: (*effects, name=…). It has: *effects,",
        ),
        (lambda: tf.scenes.microcolony(rates=1.0), "microcolony has no parameter 'rates'. Did you"),
        (lambda: tf.explain(tf.scenes.microcolony(), cell=9), "explain has no parameter 'cell'"),
        (lambda: tf.LivePlot(color="gfp"), "LivePlot has no parameter 'color'. Did you mean col"),
        (lambda: tf.from_cellmodeller("a.py", cel=2), "from_cellmodeller has no parameter 'cel'"),
        (lambda: tf.tune(tf.scenes.microcolony(), errors=0.1), "tune has no parameter 'errors'"),
    ],
)
def test_a_keyword_that_nothing_takes_is_an_error(make, words):
    with pytest.raises(tf.InputError) as caught:
        make()
    assert words in str(caught.value)


@pytest.mark.parametrize(
    "make, words",
    [
        (tf.Channel, "Channel: missing a required argument: 'width'. Its parameters: width,"),
        (lambda: tf.Sphere(centre=(0, 0)), "Sphere: missing a required argument: 'radius'."),
        (lambda: tf.Box((0, 0)), "Box: missing a required argument: 'high'."),
        (lambda: tf.Plane(0.5), "Plane: too many positional arguments."),
        (
            lambda: tf.Medium(tf.Signal(diffusion=1.0)),
            "Name each signal: Medium(ahl=tf.Signal(…), box=…, spacing=…). Its parameters: box,",
        ),
        (tf.Monod, "Monod: missing a required argument: 'signal'."),
        (tf.simulate, "simulate: missing a required argument: 'scene'."),
        (tf.Signal, "Signal: missing a required argument: 'diffusion'. Its parameters: diffusion,"),
        (lambda: tf.Cells([[0, 0]]), "Cells: missing a required argument: 'axis'."),
        (lambda: tf.LogNormal(1.0), "LogNormal: missing a required argument: 'sigma'."),
        (lambda: tf.Reaction.of("a -> b"), "of: missing a required argument: 'rate'."),
        (lambda: tf.parts.degradation("a"), "degradation: missing a required argument: 'rate'."),
        (lambda: tf.scenes.microcolony(*range(9)), "microcolony: too many positional arguments."),
        (tf.Results, "Results: missing a required argument: 'path'."),
        (tf.Recorder, "Recorder: missing a required argument: 'path'."),
        (
            tf.Circuit.from_sbml,
            "from_sbml: missing a required argument: 'path'. Its parameters: pa",
        ),
        (lambda: tf.Field("heat"), "Field: missing a required argument: 'meaning'."),
        (tf.Replay, "Replay: missing a required argument: 'model'."),
        (tf.preset, "preset: missing a required argument: 'name'."),
    ],
)
def test_an_argument_that_is_missing_is_named(make, words):
    with pytest.raises(tf.InputError) as caught:
        make()
    assert words in str(caught.value)


def test_help_shows_the_parameters_of_walls_and_effects():
    """Although their class checks each call itself."""
    assert list(inspect.signature(tf.Sphere).parameters)[:2] == ["centre", "radius"]
    assert "length_drag" in inspect.signature(tf.Mechanics).parameters
    assert pickle.loads(pickle.dumps(tf.Sphere((0, 0), 1.0))) == tf.Sphere((0, 0), 1.0)


def test_growth_without_a_rate_is_warned_of_unless_something_sets_it():
    def rule(cells):
        cells.growth_rate = 1.0

    with pytest.warns(UserWarning, match=r"Growth\(\) has no rate.*tf\.Growth\(rate=1\.0\)"):
        tf.Scene(tf.Growth(), tf.Mechanics(dim=2))
    quiet(lambda: tf.Scene(tf.Growth(), tf.Rules(rule), tf.Mechanics(dim=2)))
    quiet(tf.scenes.nutrient_limited)


def test_division_without_a_threshold_is_warned_of_unless_something_sets_the_flag():
    def rule(cells):
        cells.divide_flag = cells.length > 3.5

    effects = tf.Growth(rate=1.0), tf.Division(), tf.Mechanics(dim=2)
    scene = tf.Scene(*effects)
    with pytest.warns(UserWarning, match=r"no threshold.*no cell divides.*length=tf\.Uniform"):
        model = scene.bind()
    with pytest.raises(tf.InputError, match=r"divide_flag.*to 4 cells.*length=tf\.Uniform.*until"):
        tf.simulate(model, cells=4)
    quiet(lambda: tf.simulate(tf.Scene(tf.Rules(rule), *effects), cells=4))
    quiet(lambda: tf.Scene(tf.Growth(rate=1.0), tf.Division(length=3.5), tf.Mechanics()).bind())

    class Timer(tf.Division):
        def step(self, state, dt, values):
            state = state.with_fields(divide_flag=state.age >= 1.0)
            return super().step(state, dt, values)

    quiet(lambda: tf.simulate(tf.Scene(tf.Growth(rate=1.0), Timer(), tf.Mechanics()), cells=4))


def test_a_rate_per_minute_is_warned_of():
    with pytest.warns(UserWarning, match=r"0\.035 per hour.*20 h.*multiplied by 60 \(2\.1\)"):
        tf.Scene(tf.Growth(rate=0.035), tf.Mechanics(dim=2)).bind()


def warnings_of(make):
    """What is made, and the texts of the warnings on the way."""
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        made_here = make()
    said = [str(w.message) for w in told]
    return made_here, [text for text in said if not text.startswith("Sparse CSR")]  # torch's own


def test_a_scene_warns_once_and_its_copies_do_not():
    scene, told = warnings_of(lambda: tf.Scene(tf.Growth(), tf.Mechanics(dim=2)))
    assert len(told) == 1
    for copy in (
        lambda: scene.replace(dt=0.01),
        lambda: scene.replace(dt=0.01).replace(name="other"),
        lambda: scene.replace(*scene.effects, tf.Removal((-9, -9), (9, 9))),
        lambda: tf.Settings(passes=3).apply(scene),
    ):
        assert warnings_of(copy)[1] == []
    good = tf.Scene(tf.Growth(rate=1.0), tf.Mechanics(dim=2))
    assert len(warnings_of(lambda: good.replace(tf.Growth(), tf.Mechanics(dim=2)))[1]) == 1


def test_what_binds_a_scene_several_times_warns_once(tmp_path):
    circuit = tf.Circuit(made, species=("m",), strength=1.0, leftover=3.0)
    scene = tf.Scene(tf.Growth(rate=1.0), tf.Division(length=4.0), tf.Mechanics(dim=2), circuit)
    path = tmp_path / "run.h5"

    def recorded():
        list(tf.simulate(scene, until=0.05, record=path))

    def by_hand():
        recorder = tf.Recorder(tmp_path / "own.h5", scene)
        recorder(state)
        recorder.close()

    def restored():
        with tf.Results(path) as results:
            return results.state(scene)

    for ask in (
        scene.bind,
        scene.bind,
        lambda: tf.explain(scene, seconds=0.1),
        lambda: tf.GrowthRecording(scene, streams=[0, 1]),
        recorded,
    ):
        told = warnings_of(ask)[1]
        assert len(told) == 1 and "leftover" in told[0], told
    state, told = warnings_of(restored)
    assert told == []
    assert warnings_of(by_hand)[1] == []


def test_a_dimension_that_was_never_stated_is_warned_of():
    with pytest.warns(UserWarning, match=r"no Mechanics and no founders.*dim=2"):
        assert tf.Scene(tf.Growth(rate=1.0)).dim == 3
    assert quiet(lambda: tf.Scene(tf.Growth(rate=1.0), dim=2)).dim == 2
    assert quiet(lambda: tf.Scene(tf.Growth(rate=1.0), founders=tf.Cells.single(2))).dim == 2
    with pytest.raises(tf.InputError, match=r"Scene\.dim = 3.*2, as the mechanics are"):
        tf.Scene(tf.Mechanics(dim=2), dim=3)


@pytest.mark.parametrize("options", [{"rate": 60.0}, {"rate": 1.0, "dt": 1.5}])
def test_a_step_in_which_a_cell_divides_twice_is_an_error(options):
    scene = tf.scenes.microcolony(rate=options["rate"])
    with pytest.raises(
        tf.InputError, match=r"due to divide more than once in a step.*Take dt below"
    ):
        tf.simulate(scene, until=3.0, dt=options.get("dt"))


@pytest.mark.parametrize("effect", ["growth", "monod"])
def test_a_long_step_is_warned_of(effect):
    """By which a cell grows by more than a fifth."""
    growth = [tf.Growth(rate=1.0)]
    if effect == "monod":
        growth = [
            tf.Medium(food=tf.Signal(10.0, initial=1.0), box=((-8, -8), (8, 8)), spacing=4.0),
            tf.Monod("food", rate=1.0), tf.Growth(),
        ]  # fmt: skip
    scene = tf.Scene(*growth, tf.Division(length=4.0), dim=2)
    words = r"dt = 0\.25 h is long for \w+\.rate = 1/h: a cell grows by 28% in a step.*below 0\.2 h"
    with pytest.warns(UserWarning, match=words):
        next(tf.simulate(scene, until=1.0, dt=0.25))
    quiet(lambda: next(tf.simulate(scene, until=1.0, dt=0.2)))


def test_founders_in_one_another_are_warned_of():
    cells = tf.Cells([[0, 0], [0.1, 0.05]], [[1, 0], [1, 0]], 2.0)
    scene = tf.Scene(tf.Mechanics(dim=2), founders=cells)
    with pytest.warns(RuntimeWarning, match="deep in one another"):
        scene.bind()


def test_brackets_and_lists():
    with pytest.raises(tf.InputError, match=r"Unpack the list: Scene\(\*effects\)"):
        tf.Scene([tf.Growth(rate=1.0), tf.Mechanics(dim=2)])
    with pytest.raises(tf.InputError, match=r"Write Growth\(\) with its brackets"):
        tf.Scene(tf.Growth)


@pytest.mark.parametrize(
    "name, words",
    [
        ("x", "'x' is the place of a cell; call the species x_, or by another name."),
        ("length", "'length' is the length of a cell; call the species length_, or by"),
        ("take", "the state uses 'take' itself; call the species take_, or by another name."),
    ],
)
def test_a_species_of_a_name_that_cells_have_is_told_what_the_name_is(name, words):
    with pytest.raises(tf.InputError) as caught:
        tf.Circuit(made, species=(name,), strength=1.0)
    assert words in str(caught.value) and len(str(caught.value)) < 200


def test_a_rate_that_may_be_per_minute_is_warned_of():
    scene = tf.scenes.microcolony(rate=0.02)
    with pytest.warns(UserWarning, match=r"0.02 per hour: a doubling takes 35 h"):
        scene.bind()
