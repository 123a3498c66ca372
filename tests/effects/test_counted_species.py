"""Molecule by molecule beside others that write the same species, and genes at division."""

from __future__ import annotations

import dataclasses
import math
import warnings

import helpers
import pytest
import torch

import torchfilm as tf
from torchfilm import Reaction, parts
from torchfilm.circuits import run
from torchfilm.circuits.molecules import whole
from torchfilm.effects import circuit_daughters
from torchfilm.rule_values import RuleError

VOLUME = math.pi * 0.25 * (2 + 2 / 3)  # of a founder, µm³
STILL = [parts.degradation("gfp", 0.0)]


def bleach(cells):
    cells.gfp = cells.gfp * math.exp(-0.5 * cells.dt)


def filled(cells):
    cells.gfp = cells.gfp + 12.0 * cells.dt / cells.volume


def counts(rule, first: float, dt: float, colonies=1000, **options) -> torch.Tensor:
    """Molecules in each of the cells, which do not grow, after 4 h."""
    circuit = tf.Circuit(STILL, species="gfp", initial={"gfp": first / VOLUME}, **options)
    scene = tf.Scene(tf.Rules(rule), circuit, dim=2, dt=dt)
    *_, last = tf.simulate(scene, until=4.0, colonies=colonies, seed=1)
    found = last.gfp.double() * last.volume.double()
    assert torch.allclose(found, found.round(), atol=1e-4)
    return found.round()


@pytest.mark.parametrize("method", ["direct", "tau_leap"])
@pytest.mark.parametrize("dt", [0.025, 0.25])
def test_rules_that_change_less_than_a_molecule_keep_the_mean(method, dt):
    """30 molecules bleach to 30 e⁻² = 4.06. Each step takes 1.2 % of them: rounded to the nearest
    number, at dt = 0.025 h none was ever lost. Rounding up or down is a chance of its own: a
    variance of at most 1/4 a step, which decays as numbers do."""
    found = counts(bleach, 30.0, dt, method=method)
    steps = 4.0 / dt
    most = 0.25 * min(steps, 1 / (2 * 0.5 * dt))
    assert abs(float(found.mean()) - 30 * math.exp(-2)) < 4 * math.sqrt(most / len(found))


def test_a_rule_may_make_less_than_a_molecule_a_step():
    """12 an hour for 4 h, 0.3 a step: 48, with the variance of 160 draws of 0 or 1."""
    found = counts(filled, 0.0, 0.025, method="direct")
    variance = 160 * 0.3 * 0.7
    assert abs(float(found.mean()) - 48) < 4 * math.sqrt(variance / len(found))
    assert float(found.var()) == pytest.approx(variance, rel=4 * math.sqrt(2 / len(found)))


def test_a_smooth_circuit_may_share_a_counted_species():
    decay = tf.Circuit(
        lambda u, s, p, cell: {"gfp": -0.5 * u.gfp}, species="w", shared={"gfp": "A_gfp"}, name="B"
    )
    counted = tf.Circuit(STILL, species="gfp", method="direct", name="A", initial={"gfp": 30.0})
    *_, last = tf.simulate(tf.Scene(counted, decay, dim=2, dt=0.025), until=4.0, colonies=300)
    first = round(30.0 * VOLUME)
    found = (last.A_gfp * last.volume).double()
    assert abs(float(found.mean()) - first * math.exp(-2)) < 4 * math.sqrt(0.25 * 40 / 300) + 0.1


def test_what_rules_write_is_rounded_by_a_cell_s_own_draws():
    """So the bits do not depend on the batch."""
    circuit = tf.Circuit(
        [parts.degradation("gfp", 0.3), parts.constitutive("gfp", 30.0)], species="gfp",
        method="tau_leap", initial={"gfp": 10.0},
    )  # fmt: skip
    scene = tf.Scene(
        tf.Rules(bleach), tf.Growth(rate=1.0), tf.Division(length=tf.Uniform(3.0, 4.0)), circuit,
        dim=2, dt=0.05,
    )  # fmt: skip
    helpers.check_same_bits_alone(scene, until=2.0, seed=3)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_whole_numbers_stay(dtype):
    """Numbers that are whole but for the rounding of a concentration times a volume draw nothing;
    others are rounded so that the mean stays."""
    count = torch.arange(0, 200_000, 7, dtype=dtype)
    volume = torch.rand(count.shape, dtype=torch.float64).to(dtype) + 1
    no_draw = lambda: pytest.fail("drawn")
    assert torch.equal(whole((count / volume) * volume, no_draw), count)
    third = torch.full((30_000,), 7 + 1 / 3, dtype=dtype)
    found = whole(third, lambda: torch.rand(len(third), dtype=torch.float64))
    assert set(found.tolist()) == {7.0, 8.0}
    assert abs(float(found.double().mean()) - 7 - 1 / 3) < 4 * math.sqrt(2 / 9 / len(third))


@pytest.mark.parametrize("backend", ["compiled", "torch"])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_nothing_is_drawn_where_nobody_writes(monkeypatch, backend, dtype):
    """Roundings of growth, division and reactions do not count as writes."""
    monkeypatch.setattr(run, "whole", lambda x, draw, own: whole(x, lambda: pytest.fail("!"), own))
    monkeypatch.setattr(
        circuit_daughters, "whole", lambda x, draw: whole(x, lambda: pytest.fail("!"))
    )
    circuit = tf.Circuit(
        [parts.degradation("gfp", 0.3), parts.constitutive("gfp", 3000.0)], species="gfp",
        method="tau_leap", initial={"gfp": 5000.0}, backend=backend,
    )  # fmt: skip
    scene = tf.Scene(tf.Growth(rate=1.5), tf.Division(length=3.0), circuit, dim=2, dt=0.05)
    *_, last = tf.simulate(scene, scene.bind(2, dtype=dtype).start(), until=2.0)
    assert last.cells > 20


def test_a_rule_that_writes_before_a_division_keeps_the_mean():
    """A third of a molecule more in each step, and a division in each tenth: 2 · 10/3 molecules in
    all, of which roundings at divisions took none."""

    def adds(cells):
        cells.gfp = cells.gfp + 0.03 / cells.volume
        cells.divide_flag = (cells.length > 0) & (round(cells.time * 10) == 10)

    circuit = tf.Circuit(STILL, species="gfp", method="direct", initial={"gfp": 10.0 / VOLUME})
    founder = tf.Cells([[0.0, 0]], [[1.0, 0]], length=4.0)
    scene = tf.Scene(tf.Rules(adds), tf.Division(), circuit, founders=founder, dim=2, dt=0.1)
    *_, last = tf.simulate(scene, until=2.0, colonies=1000, seed=5)
    assert last.cells == 2000
    total = (last.gfp * last.volume).double().sum() / 1000
    first = 10.0 / VOLUME * math.pi * 0.25 * (4 + 2 / 3)
    made = 0.03 * (10 + 2 * 10)
    assert abs(float(total) - first - made) < 4 * math.sqrt(0.25 * 32 / 1000)


def test_species_are_shared_independently():
    still = [parts.degradation(n, 0.0) for n in "ab"]
    circuit = tf.Circuit(
        still, species=("a", "b"), method="direct", initial={"a": 40 / VOLUME, "b": 40 / VOLUME}
    )
    scene = tf.Scene(tf.Growth(rate=1.0), tf.Division(length=3.0), circuit, dim=2, dt=0.05)
    for last in tf.simulate(scene, until=1.0, colonies=2000, seed=2):
        if last.cells == 4000:
            break
    a, b = ((x * last.volume).double()[::2] for x in (last.a, last.b))
    assert len(a) == 2000 and float(a.var()) == pytest.approx(10.0, rel=0.15)
    assert abs(float(torch.corrcoef(torch.stack([a, b]))[0, 1])) < 4 / math.sqrt(2000)


def test_the_mean_of_a_switch_does_not_depend_on_noise():
    """Both ways share amounts at divisions: the smooth run had 5 % less."""
    means = []
    for noise in (True, False):
        ready = tf.scenes.toggle_switch(noise=noise, molecules_per_unit=2000.0)
        high = [
            dataclasses.replace(e, initial={"red": 5.0, "green": 0.1})
            if isinstance(e, tf.Circuit) else e for e in ready.effects
        ]  # fmt: skip
        late = [s for s in tf.simulate(ready.replace(*high), until=6.0) if s.time > 4.0]
        held = [float((s.red * s.volume).sum() / s.volume.sum()) for s in late]
        means.append(sum(held) / len(held))
    assert means[0] == pytest.approx(means[1], rel=0.005)


TELEGRAPH = [
    Reaction.of("off -> on", 2.0),
    Reaction.of("on -> off", 6.0),
    Reaction({"on": 1}, {"on": 1, "m": 1}, 80.0),
    parts.degradation("m", 4.0),
]


def telegraph(method="direct", copies=1, **options) -> tf.Scene:
    return tf.Scene(
        tf.Growth(rate=1.0, law="volume"),
        tf.Division(length=tf.Uniform(3.5, 4.5), conserves="volume"),
        tf.Circuit(
            TELEGRAPH, species=("off", "on", "m"), initial={"off": copies / VOLUME}, method=method,
            **options,
        ),
        dim=2, dt=0.02,
    )  # fmt: skip


@pytest.mark.parametrize("copies", [1, 2, 5])
def test_a_gene_is_replicated(copies):
    """Every cell has its parent's copies. The number of messages
    of all cells grows at 1/h, as that of cells does: their mean is copies · 80 · ¼/(4 + 1)."""
    scene = telegraph(copies=copies, replicated=("off", "on"))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        *_, last = tf.simulate(scene, until=5.0, colonies=40, seed=3)
    genes, messages = ((last.off + last.on) * last.volume), (last.m * last.volume).double()
    assert torch.allclose(genes, torch.full_like(genes, copies), atol=1e-4)
    # a Fano factor of 6 or so: 1 + 80·6/(8·(8 + 5)); few cells are related by less than an hour
    error = math.sqrt(6 * 4 * copies / (last.cells / 2))
    assert abs(float(messages.mean()) - 4 * copies) < 4 * error


@pytest.mark.parametrize("daughters", ["concentration", "amount"])
def test_a_smooth_gene_is_replicated(daughters):
    scene = telegraph("rosenbrock", replicated=("off", "on"), daughters=daughters)
    *_, last = tf.simulate(scene, until=5.0, colonies=2, seed=3)
    genes = (last.off + last.on) * last.volume
    assert last.cells > 100
    assert torch.allclose(genes, torch.ones_like(genes), atol=1e-3)


def test_genes_that_a_division_loses_are_warned_of():
    with pytest.warns(UserWarning, match=r"number of off \+ on.*replicated=\('off', 'on'\)"):
        *_, last = tf.simulate(telegraph(), until=3.0, colonies=4, seed=3)
    genes = ((last.off + last.on) * last.volume).round()
    assert float(genes.sum()) == 4  # one a colony, as ever


@pytest.mark.parametrize("options", [{"copies": 2}, {"replicated": ("on",)}])
def test_two_copies_and_states_that_are_not_all_replicated_are_warned_of(options):
    with pytest.warns(UserWarning, match=r"number of off \+ on"):
        next(tf.simulate(telegraph(**options), until=0.1))


def test_genes_of_one_type_of_cells_are_seen():
    """Where few of the founders have it."""
    founders = tf.Cells(
        [[4.0 * k, 0.0] for k in range(5)], [[1.0, 0.0]] * 5, cell_type=[1, 0, 0, 0, 0]
    )
    circuit = tf.Circuit(
        {1: TELEGRAPH}, species=("off", "on", "m"), method="direct",
        initial={"off": {0: 0.0, 1: 1 / VOLUME}},
    )  # fmt: skip
    scene = tf.Scene(
        tf.Growth(rate=1.0), tf.Division(length=4.0), circuit, founders=founders, dim=2, dt=0.02
    )
    with pytest.warns(UserWarning, match=r"number of off \+ on"):
        next(tf.simulate(scene, until=0.1))


def test_genes_that_a_rule_copies_are_not_warned_of():
    def copied(parent, d1, d2):
        for d in (d1, d2):
            d.on = parent.on * parent.volume / d.volume
            d.off = parent.off * parent.volume / d.volume

    by_hand = tf.Scene(tf.Rules(None, copied), *telegraph().effects, dim=2, dt=0.02)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        *_, last = tf.simulate(by_hand, until=2.0, colonies=3)
    genes = (last.off + last.on) * last.volume
    assert torch.allclose(genes, torch.ones_like(genes), atol=1e-4)


def test_many_molecules_or_no_division_are_not_warned_of():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        next(tf.simulate(telegraph(copies=30), until=0.1))
        alone = [e for e in telegraph().effects if not isinstance(e, tf.Division)]
        next(tf.simulate(tf.Scene(*alone, dim=2, dt=0.02), until=0.1))


@pytest.mark.parametrize(
    ("options", "match"),
    [
        ({"replicated": "gene"}, "Circuit.replicated names 'gene'"),
        ({"replicated": 3}, "Circuit.replicated = 3 is not allowed"),
        ({"replicated": None}, "Circuit.replicated = None is not allowed"),
        ({"dilution": 3, "method": "rosenbrock"}, "Circuit.dilution = 3 is not allowed"),
        ({"replicated": "on", "method": "rosenbrock", "dilution": False}, "'on' is not diluted"),
        ({"replicated": "on", "method": "rosenbrock", "dilution": ("m",)}, "'on' is not diluted"),
    ],
)
def test_bad_names_of_replicated_species(options, match):
    with pytest.raises(tf.InputError, match=match):
        telegraph(**options)


def test_molecules_of_a_circuit_are_a_number_for_binomial():
    """A concentration times a volume is whole but for rounding."""

    def halves(parent, d1, d2):
        n = parent.a * parent.volume
        k = parent.binomial(n, 0.5)
        d1.a, d2.a = k / d1.volume, (n - k) / d2.volume

    circuit = tf.Circuit(
        [Reaction.of("a -> 0", 0.0)], species="a", initial={"a": 14.3}, method="direct"
    )
    scene = tf.Scene(
        tf.Rules(None, halves), tf.Growth(rate=1.0), tf.Division(length=4.0), circuit, dim=2
    )
    *_, last = tf.simulate(scene, until=3.5, colonies=50, seed=1)
    of_colony = last.groups.sum((last.a * last.volume).double()).round()
    assert {29.0, 30.0} >= set(of_colony.tolist())  # 14.3 · 2.09 µm³ = 29.95

    with pytest.raises(RuleError, match=r"the number 30\.5: it must be whole"):
        wrong = tf.Rules(lambda cells: cells.binomial(30.5, 0.5))
        next(tf.simulate(tf.Scene(wrong, tf.Growth(rate=1.0), dim=2), until=0.1))
