"""What explain says is what will be done: methods are those chosen, tolerances those used, and the
estimate is the arithmetic that it claims to be."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from pathlib import Path

import pytest
import torch

import torchfilm as tf
from torchfilm.effects import KNOWN, medium_transport
from torchfilm.effects.bound_medium import FirstHalf
from torchfilm.effects.mechanics import TOLERANCE
from torchfilm.effects.medium_coverage import GridCoverage
from torchfilm.explanation import left_out, replayed
from torchfilm.kernels.scheme import OVERLAP, PASSES
from torchfilm.kernels.scheme import TOLERANCE as FORCE_TOLERANCE
from torchfilm.physics import bilateral, compiled, one_sided
from torchfilm.signals.exchange import turns_error

BODY = (tf.Growth(rate=1.0), tf.Division(length=tf.Uniform(3.5, 4.5)), tf.Mechanics(dim=2))
BOX = {"box": ((-32.0, -32.0), (32.0, 32.0)), "spacing": 8.0}


def plain(u, s, p, cell):
    return {"m": 1.0 - u.m}


def medium(decay=0.1, **options) -> tf.Medium:
    return tf.Medium(ahl=tf.Signal(diffusion=10.0, decay=decay), **BOX, **options)


def pillar(places):
    return places[:, 0] > 28.0


def swirl(places):
    return torch.stack([places[:, 1], -places[:, 0], torch.zeros_like(places[:, 0])], 1) * 0.01


def graded(places):
    return 0.01 * (places[:, 0] + 40.0)


# --- methods --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "made, words",
    [
        (medium(), "no obstacle"),
        (medium(flow=(1.0, 0.0)), "no obstacle"),
        (medium(decay=torch.tensor([0.1, 0.2])), "no obstacle"),
        (medium(obstacles=pillar), "because of obstacles"),
        (medium(flow=swirl), "a flow that differs"),
        (medium(decay=graded), "a decay that differs"),
        (medium(flow=swirl, obstacles=pillar), "obstacles and a flow"),
    ],
    ids=[
        "plain",
        "uniform flow",
        "decay per colony",
        "obstacle",
        "varying flow",
        "varying decay",
        "two reasons",
    ],
)
def test_the_way_of_transport_reported_is_the_one_that_is_chosen(made, words, monkeypatch):
    chosen, choose = [], medium_transport.choose
    monkeypatch.setattr(
        medium_transport, "choose", lambda op: chosen.append(choose(op)) or chosen[-1]
    )
    scene = tf.Scene(*BODY, made)
    model = scene.bind(2)
    model.step(model.start())
    method, why = made.method_of("ahl")
    assert set(chosen) == {method} and words in why
    assert f"ahl: {method}, " in tf.explain(scene, seconds=0)


@pytest.mark.parametrize("method", ["exponential", "implicit", "crank_nicolson", "euler"])
def test_a_way_of_transport_that_was_asked_for_is_reported(method):
    made = medium(method=method)
    assert made.method_of("ahl") == (method, "as given")
    assert f"ahl: {method}, " in tf.explain(tf.Scene(*BODY, made), seconds=0)


@pytest.mark.parametrize(
    "effect, words",
    [
        (
            tf.Mechanics(dim=2),
            (
                "one-sided, they only push",
                f"a mean overlap of {OVERLAP:g} radii",
                f"at most {PASSES} a step, more than one only around cells deeper than 0.2 radii",
                f"contact forces to {FORCE_TOLERANCE:g}",
                "at most 2000 iterations",
            ),
        ),
        (
            tf.Mechanics(dim=2, contact_overlap=0.03, tolerance=0.03, passes=2),
            ("a mean overlap of 0.03 radii", "at most 2 a step", "contact forces to 0.03, at most"),
        ),
        (tf.Mechanics(dim=2, backend="torch"), ("conjugate gradients, torch, contact forces",)),
        (
            tf.Mechanics(dim=2, contacts="bilateral", length_drag=10.0),
            (
                "bilateral",
                "α = 0.1/γ = 0.01 (default)",
                "at most 1 a step",
                "residual of 0.005 (default)",
                "at most 2000 iterations",
            ),
        ),
        (
            tf.Mechanics(dim=2, contacts="bilateral", length_drag=40.0),
            ("α = 0.1/γ = 0.0025 (default)",),
        ),
        (tf.Mechanics(dim=2, contacts="bilateral", tolerance=0.03), ("residual of 0.03, at most",)),
        # 1/(k Δt), Δt = 0.025
        (
            tf.Mechanics(dim=2, stiffness=[100.0, 200.0]),
            ("stiffness 100 to 200 μ·µm/h", "= 0.2 to 0.4", "passes: 1 a step, as cells are soft"),
        ),
        (
            tf.Mechanics(dim=2, alpha=0.5, passes=4, overlap=0.01),
            ("α = 0.5", "at most 4 a step", "deeper than 0.01 µm"),
        ),
        (
            tf.Mechanics(dim=2, contacts="bilateral", alpha=0.5, passes=4, overlap=0.01),
            ("α = 0.5", "at most 4 a step", "over 0.01 µm"),
        ),
        (
            tf.Mechanics(
                dim=2,
                walls=[tf.Plane(y=-2.0, facing="+y"), tf.Plane(y=2.0, facing="-y", stiffness=3.0)],
            ),
            ("1 hard, 1 with a stiffness",),
        ),
        (tf.Circuit(plain, species="m"), ("stiff solver", "1e-09 + 0.0001·|u|")),
        (tf.Circuit(plain, species="m", rtol=1e-2, atol=1e-6), ("1e-06 + 0.01·|u|",)),
        (
            tf.Circuit(plain, species="m", method="rk4", steps=5),
            ("rk4, 5 equal step(s) of 0.005 h",),
        ),
        (
            tf.Circuit(
                [tf.parts.constitutive("m", 1.0)],
                species="m",
                method="tau_leap",
                molecules_per_unit=0.6022,
            ),
            ("tau-leaping", "0.6022 molecules"),
        ),
        (
            tf.Circuit([tf.parts.constitutive("m", 1.0)], species="m", method="direct"),
            ("one event after the other", "1 molecules"),
        ),
        # 0.025 · 10/64
        (
            medium(outside="grow", grows="x"),
            ("along x, 8 voxels", "8 × 8 × 1 voxels of 8 × 8 × 8 µm", "dt·K/h² = 0.003906"),
        ),
        (
            medium(method="crank_nicolson", steps=5),
            ("order 2 in steps of 0.0025 h", "fails", "Strang"),
        ),
        (
            medium(method="implicit", splitting="lie", steps=5),
            ("order 1 in steps of 0.005 h", "Lie"),
        ),
        (medium(outside="reservoir"), ("reservoir",)),
    ],
)
def test_methods_and_tolerances_are_those_of_the_scene(effect, words):
    body = [e for e in BODY if e.title != effect.title]
    said = tf.explain(tf.Scene(*body, effect), seconds=0)
    for part in words:
        assert part in said, said


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("contacts", ["bilateral", "one-sided"])
def test_defaults_reported_of_contacts_are_those_used(dim, contacts):
    effect = tf.Mechanics(dim=dim, contacts=contacts)
    model = tf.Scene(effect, tf.Growth(rate=1.0)).bind()
    bound = next(e for e in model.effects if e.effect is effect)
    said = " ".join(bound.numerics(0.025, model.start()))
    used = bound.settings
    assert f"at most {used.passes} a step" in said
    if contacts == "one-sided":
        assert f"a mean overlap of {used.contact_overlap:g} radii" in said
        assert f"contact forces to {used.tolerance:g}, " in said
    else:
        assert f"residual of {TOLERANCE:g} (default)" in said


@pytest.mark.parametrize("contacts", ["bilateral", "one-sided"])
@pytest.mark.parametrize("backend", [None, "compiled", "torch"])
def test_who_computes_contacts_is_who_is_reported(backend, contacts, monkeypatch):
    called = []
    parts = {"compiled": compiled, "one-sided": one_sided, "bilateral": bilateral}
    for name, part in parts.items():
        function = "step" if name == "compiled" else "contact_steps"
        usual = getattr(part, function)
        steps = lambda *given, name=name, usual=usual: called.append(name) or usual(*given)
        monkeypatch.setattr(part, function, steps)
    effect = tf.Mechanics(dim=2, backend=backend, contacts=contacts)
    model = tf.Scene(effect, tf.Growth(rate=1.0)).bind()
    model.step(model.start(), 0.025)
    by_torch = backend == "torch"
    assert called == [contacts if by_torch else "compiled"]
    by = "by" if contacts == "bilateral" else "assembled by"
    said = "torch," if by_torch else f"compiled; {by} torch where gradients are required,"
    assert f"conjugate gradients, {said}" in " ".join(effect.numerics(0.025, model.start()))


def test_what_is_exchanged_is_named():
    assert "transport of ahl in one equation" in tf.explain(tf.scenes.quorum_sensing(), seconds=0)
    assert "exchanges" not in tf.explain(tf.scenes.toggle_switch(), seconds=0)


def test_every_effect_that_torchfilm_has_is_known_and_has_words():
    public = {
        x
        for x in vars(tf).values()
        if isinstance(x, type) and issubclass(x, tf.Effect) and x is not tf.Effect
    }
    assert public == set(KNOWN.values())

    def watching(cells):
        cells.mark = cells.length * 2.0

    model = tf.Scene(
        BODY[1],
        tf.Mechanics(dim=2, walls=[tf.Plane(y=-0.5, facing="+y")]),
        tf.Growth(),
        tf.Monod("ahl"),
        tf.Rules(watching),
        tf.Circuit(plain, species="m"),
        medium(),
        tf.Motility(1.0, reversals=1.0),
        tf.Lysis(rate=0.1),
        tf.MediumReactions(lambda s, p: {"ahl": -s.ahl}),
        tf.Removal((-50, -50), (50, 50)),
        tf.Erosion(0.01, floor=-50.0, across={"x": (-50, 50)}),
        tf.Sloughing(),
    ).bind()
    state = model.start()
    assert {type(e.effect) for e in model.effects} == public
    assert {FirstHalf, GridCoverage} <= {type(e) for e in model.effects}
    for effect in model.effects:
        words = effect.numerics(0.025, state)
        assert words and all(words), effect.title
        assert type(effect).__name__ not in effect.summary(), "a part has a plain sentence"


def test_an_effect_of_ones_own_is_reported_by_its_name_alone():
    class Mine(tf.Growth):
        title = "mine"

    @dataclass(frozen=True)
    class Other(tf.Effect):
        stage, title = 35, "other"

    model = tf.Scene(*BODY, Other()).bind()
    (other,) = (e for e in model.effects if isinstance(e.effect, Other))
    assert other.numerics(0.025, model.start()) == []
    lines = tf.explain(model.scene, seconds=0).splitlines()
    at = next(k for k, line in enumerate(lines) if line.startswith("  other "))
    assert not lines[at + 1].startswith(" " * 13)
    assert "mine" in tf.explain(tf.Scene(Mine(rate=1.0), dim=3), seconds=0)


# --- who, what not, and again ---------------------------------------------------------------------


@pytest.mark.parametrize("name", tf.scenes.READY)
def test_what_is_listed_and_what_is_left_out_are_all(name):
    scene = tf.scenes.build(name)
    listed, left = [e.title for e in scene.effects], left_out(scene)
    assert sorted(listed + left) == sorted(KNOWN)
    assert f"not simulated: {', '.join(left)} (no field, no operation)" in tf.explain(
        scene, seconds=0
    )


@pytest.mark.parametrize("name", tf.scenes.READY)
def test_whether_growth_serves_many_designs_is_what_a_course_says(name):
    scene = tf.scenes.build(name)
    model = scene.bind()
    why, said = model.why_not_replayable, replayed(model)
    each, once = "each design grows colonies of its own", "colonies are grown once for all designs"
    assert said == f"{each}, because {why}" if why else said.startswith(f"{once}, because ")
    assert f"\n  in a search: {said}" in tf.explain(scene, seconds=0)
    if name == "boundary_detector":
        assert "because circuit and transport change neither growth nor motion (tf." in said
    if name == "toggle_switch":
        assert "because circuit changes neither growth nor motion (tf." in said


@pytest.mark.parametrize("name", tf.scenes.READY)
def test_couplings_are_those_of_the_scene(name):
    scene = tf.scenes.build(name)
    said, info = tf.explain(scene, seconds=0), scene.bind().describe()
    assert scene.bind().drives() and all(
        f"    {line}\n" in said and f"    {line}" in info for line in scene.bind().drives()
    )
    assert {tuple(line.split(": ")[0].split(" -> ")) for line in scene.bind().drives()} == {
        (w, r) for w, _, r in scene.bind().couplings()
    }


def test_without_an_estimate_nothing_runs(monkeypatch):
    def input_error(*_):
        raise AssertionError("a step was taken")

    monkeypatch.setattr(tf.Model, "step", input_error)
    said = tf.explain(tf.scenes.boundary_detector(), seconds=0)
    assert "estimated" not in said and said == tf.explain(tf.scenes.boundary_detector(), seconds=0)


# --- input and the command line -------------------------------------------------------------------


@pytest.mark.parametrize(
    "options, word",
    [
        ({"cells": 0}, "cells = 0"),
        ({"cells": True}, "cells = True"),
        ({"colonies": 0}, "colonies = 0"),
        ({"colonies": 1.5}, "colonies = 1.5"),
        ({"seconds": -1}, "seconds = -1"),
        ({"seconds": math.nan}, "seconds = nan"),
        ({"device": "banana"}, "device = 'banana'"),
    ],
)
def test_bad_options_are_refused(options, word):
    with pytest.raises(tf.InputError, match=word):
        tf.explain(tf.scenes.microcolony(), **options)


def test_as_many_colonies_as_the_parameters_are_for():
    scene = tf.Scene(tf.Growth(rate=[0.5, 1.0, 1.5]))
    assert "in each of 3 colonies" in tf.explain(scene, seconds=0.01)
    with pytest.raises(tf.InputError, match=r"colonies = 4 .* must be 3"):
        tf.explain(scene, colonies=4)


def test_the_command_says_what_the_function_says(command, capsys):
    command("explain", "microcolony", "--set", "dim=3", "--seconds", 0)
    assert capsys.readouterr().out == tf.explain(tf.scenes.microcolony(dim=3), seconds=0) + "\n"
    Path("mine.py").write_text(
        "import torchfilm as tf\nscene = tf.Scene(tf.Growth(rate=1.0), tf.Division(length=4.0))\n"
    )
    command("explain", "mine.py", "--cells", 20, "--colonies", 2, "--seconds", 0.02)
    out = capsys.readouterr().out
    assert out.startswith("mine: 3-D") and "20 cells in each of 2 colonies" in out
    with pytest.raises(SystemExit, match=r"scene = 'nowhere'"):
        command("explain", "nowhere")


def test_the_device_is_the_one_that_was_measured(device):
    assert f"{device.type}, float32" in tf.explain(tf.Scene(*BODY), device=device, seconds=0.02)


def test_what_taking_turns_costs_a_signal_is_said_where_it_is_much():
    """And not of a signal that diffuses slowly, or in short steps."""
    fast = tf.Scene(*BODY, tf.Medium(ahl=tf.Signal(diffusion=3000.0, decay=1.0), **BOX))
    grid = fast.bind().start().layout.grid
    said = " ".join(tf.explain(fast, seconds=0).split())
    found = re.search(r"signal up to ([\d.]+) % too low; below 1 % in steps of ([\d.]+) h", said)
    low, enough = map(float, found.groups())
    assert low == pytest.approx(-100 * turns_error(3000.0, 1.0, grid, fast.dt), rel=0.05)
    off = [turns_error(3000.0, 1.0, grid, step) for step in (enough, 2 * enough)]
    assert off[0] > -0.01 > off[1]
    assert "take turns" not in tf.explain(fast.replace(dt=enough), seconds=0)
    assert "take turns" not in tf.explain(tf.Scene(*BODY, medium()), seconds=0)


def test_a_depth_that_goes_by_the_spacing_is_said():
    assert "as deep as a voxel is wide" in tf.explain(tf.Scene(*BODY, medium()), seconds=0)
    assert "as deep as" not in tf.explain(tf.Scene(*BODY, medium(depth=8.0)), seconds=0)


def test_a_prompt_and_a_notebook_show_its_lines():
    told = tf.explain(tf.Scene(tf.Growth(rate=1.0), dim=2), seconds=0)
    assert repr(told) == str(told) and "\n" in repr(told)
    assert told._repr_html_().startswith("<pre") and told.splitlines()[0] in told._repr_html_()


@pytest.mark.parametrize(
    ("signal", "words"),
    [
        ({"diffusion": 100.0, "decay": 4.0}, "m reaches √(K/k) = 5 µm: 1.2 voxels, too few to"),
        ({"diffusion": [400.0, 1600.0], "decay": 4.0}, "m reaches √(K/k) = 10 to 20 µm\n"),
        ({"diffusion": 100.0}, None),
        ({"diffusion": 100.0, "decay": lambda places: places[:, 0] * 0 + 1.0}, None),
    ],
)
def test_how_far_a_signal_reaches_beside_the_voxels(signal, words):
    box = tf.Medium(m=tf.Signal(initial=1.0, **signal), box=((0, 0), (16, 16)), spacing=4.0)
    scene = tf.Scene(box, dim=2, founders=tf.Cells([[8.0, 8.0]], [[1.0, 0.0]]))
    told = str(tf.explain(scene, seconds=0))
    assert words in told if words else "reaches" not in told


@pytest.mark.parametrize("speed", [30.0, 400.0, 0.5])
def test_what_voxels_add_to_diffusion_where_it_flows(speed):
    """Said as it is: the variance of a pulse grows by 2 (K + what they add) t."""
    pulse = lambda at: torch.exp(-0.5 * ((at[:, 0] + 80.0) / 8.0) ** 2)
    medium = tf.Medium(
        m=tf.Signal(10.0, initial=pulse), box=((-200, -2), (200, 2)), spacing=2.0,
        flow=(speed, 0.0), boundary=tf.BoundaryConditions(x=tf.NoFlux(), y=tf.NoFlux()),
    )  # fmt: skip
    scene = tf.Scene(medium, dim=2, founders=tf.Cells([[0.0, 0.0]], [[1.0, 0.0]]), dt=0.02)
    found = re.search(r"m: voxels add ([\d.]+) µm²/h .* along x", str(tf.explain(scene, seconds=0)))
    if speed < 1:
        assert found is None
        return
    first = scene.bind(dtype=torch.float64).start()
    *_, last = tf.simulate(scene, first, until=0.2)
    x = first.layout.grid.centres()[:, 0].double()
    mean = lambda s, of: float((s.signals["m"] * of).sum() / s.signals["m"].sum())
    variance = lambda s: mean(s, (x - mean(s, x)) ** 2)
    grown = (variance(last) - variance(first)) / (2 * 0.2)
    assert grown - 10.0 == pytest.approx(float(found[1]), rel=0.02)


@pytest.mark.parametrize(("spacing", "said"), [(2.0, False), (1.0, True)])
def test_voxels_finer_than_cells_are_said(spacing, said):
    """A round cell exchanges with the voxels about its centre, and starved on finer ones."""
    large = tf.Cells([[0.0, 0.0]], [[1.0, 0.0]], length=0.0, radius=2.0)
    food = tf.Signal(diffusion=200.0, initial=0.5)
    medium = tf.Medium(food=food, box=((-16, -16), (16, 16)), spacing=spacing, depth=4.0)
    scene = tf.Scene(tf.Monod("food"), tf.Growth(), medium, founders=large, dt=0.02)
    words = "are finer than cells, of radii up to 2 µm"
    assert (words in " ".join(tf.explain(scene, seconds=0).split())) == said


@pytest.mark.parametrize("several", [False, True])
def test_circuits_that_share_a_signal_are_of_first_order_between_them(several):
    def leaks(u, s, p, cell):
        out = (u.a - s.a) * cell.area
        return {"a": 1.0 - out / cell.volume}, {"a": out}

    def eats(u, s, p, cell):
        return {"got": s.a}, {"a": -s.a * cell.volume}

    more = [tf.Circuit(eats, species="got", name="eater")] if several else []
    scene = tf.Scene(
        tf.Circuit(leaks, species="a"), *more,
        tf.Medium(a=tf.Signal(diffusion=50.0), box=((-8, -8), (8, 8)), spacing=4.0, depth=1.0),
        dim=2,
    )  # fmt: skip
    found = str(tf.explain(scene))
    assert "a: transport by a series, order 2 in dt" in found
    assert ("order 1 between them" in found) is several
