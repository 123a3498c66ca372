"""Derivatives of losses by parameters, and the local search that uses them."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from asking import Room
from patterned import crowded
from searching import lit, objective_of, paced

import torchfilm as tf
from design import Choice, Parameter, Search, Study, colonies, scene_family
from design.derivatives import along
from design.growing import grow
from design.methods import Local
from design.scoring import cut_work_items, run_work_item
from design.slopes import Slopes
from design.targets import Bands, Burden, Gradient, Lasting, Ring, Stripe, Weighted

TARGETS = {
    "bands": Bands(("yfp", "cfp"), (-6.0, 0.0, 6.0), floor=0.3),
    "ring": Ring("yfp", 4.0, 3.0),
    "gradient": Gradient("cfp", "x", -5.0, 5.0, floor=1.0),
    "stripe": Stripe("yfp", width=4.0, cell_type=1),
    "out of reach": Stripe("yfp", at=500.0, width=4.0),
}
EDGES = Bands(("gfp",), (-3.0, 3.0), floor=0.5)
TWO = [Parameter("make", 0.1, 10.0, log=True), Parameter("decay", 0.1, 5.0)]
POINTS = np.array([[0.3, 0.6], [0.8, 0.2]])
GRID = np.linspace(0.0, 1.0, 11)


@pytest.mark.parametrize("name", TARGETS)
def test_squares_of_residuals_add_up_to_the_loss(name):
    state, target = crowded(), TARGETS[name]
    found = target.residuals(state)
    assert found.shape[0] == state.colonies
    assert found.square().sum(1).numpy() == pytest.approx(target.loss(state).numpy(), abs=1e-12)


def test_a_colony_that_cannot_be_scored_has_the_residual_of_its_loss():
    state = crowded()
    broken = torch.where(state.colony == 1, torch.nan, state.fields["yfp"])
    state = state.with_fields(yfp=broken)
    target = TARGETS["ring"]
    found = target.residuals(state).square().sum(1)
    assert found.numpy() == pytest.approx(target.loss(state).numpy(), abs=1e-12)
    assert float(found[1]) == pytest.approx(target.failed)


@pytest.mark.parametrize("reduce", ["mean", "worst", 0.75])
def test_slopes_are_differences_of_losses(reduce):
    objective = objective_of(
        lit, TWO, EDGES, cells=8, replicates=3, reduce=reduce, dtype=torch.float64
    )
    assert objective.why_differences == ""
    found = objective.evaluate(POINTS, slopes=True)
    plain = objective.evaluate(POINTS)
    assert found.copies == 2 and plain.copies == 1 and plain.slopes is None
    assert found.losses == pytest.approx(plain.losses, rel=1e-9)
    for k in range(2):
        step = np.eye(2)[k] * 2e-4
        more, less = (objective.evaluate(POINTS + s).loss for s in (step, -step))
        difference = (more - less) / 4e-4
        assert np.abs(difference).max() > 1e-3, "the loss should depend on it"
        assert found.slopes.gradient[:, k] == pytest.approx(difference, rel=0.02, abs=1e-5)


def test_curvature_is_that_of_the_residuals():
    """2 JᵀJ by finite differences of the residuals themselves."""
    objective = objective_of(lit, TWO, EDGES, cells=8, replicates=2, dtype=torch.float64)
    found = objective.evaluate(POINTS[:1], slopes=True).slopes

    def residuals(point):
        return [EDGES.residuals(c.state, c.history) for c in objective.colonies(point)]

    columns = []
    for k in range(2):
        step = np.eye(2)[k] * 2e-4
        ends = zip(residuals(POINTS[0] + step), residuals(POINTS[0] - step), strict=True)
        columns.append(torch.cat([((a - b) / 4e-4).reshape(-1) for a, b in ends]).numpy())
    j = np.stack(columns, 1)
    assert found.curvature[0] == pytest.approx(2 * j.T @ j / 2, rel=0.03)
    own = np.linalg.eigvalsh(found.curvature[0])
    assert own.min() >= -1e-12


LASTING = Lasting(EDGES, since=0.4)


def test_a_pattern_that_lasts_has_the_residuals_of_all_its_steps():
    """By hand: of each step from `since` on, and their weights. Gradient and 2 JᵀJ are finite
    differences of those."""
    options = {"cells": 8, "replicates": 2, "dtype": torch.float64}
    objective = objective_of(lit, TWO, LASTING, **options)
    assert objective.least_squares

    def courses(point):
        """Residuals of each colony at its steps, put together by hand."""
        out = []
        task = objective.task
        for stream in range(2):
            scene = task.family.scene([task.space.values(point)], repeat=1)
            prepared = colonies.prepare(scene, [stream], task.settings)
            steps, losses = [], []

            def seen(state, steps=steps, losses=losses):
                if state.time > 0.4 - 1e-9:
                    steps.append(EDGES.residuals(state)[0])
                    losses.append(float(EDGES.loss(state)))

            list(grow(prepared, cells=8, until=None, note=seen))
            whole = torch.cat(steps).numpy() / np.sqrt(len(steps))
            assert len(steps) > 5 and float(whole @ whole) == pytest.approx(np.mean(losses))
            out.append(whole)
        return out

    found = objective.evaluate(POINTS, slopes=True)
    plain = objective.evaluate(POINTS)
    assert found.losses == pytest.approx(plain.losses, rel=1e-9)
    middle = courses(POINTS[0])
    assert plain.losses[0] == pytest.approx([r @ r for r in middle], rel=1e-9)
    columns = []
    for k in range(2):
        step = np.eye(2)[k] * 2e-4
        ends = zip(courses(POINTS[0] + step), courses(POINTS[0] - step), strict=True)
        columns.append(np.concatenate([(a - b) / 4e-4 for a, b in ends]))
    j, r = np.stack(columns, 1), np.concatenate(middle)
    assert found.slopes.curvature[0] == pytest.approx(j.T @ j, rel=0.03)
    assert found.slopes.gradient[0] == pytest.approx(j.T @ r, rel=0.03)


def test_residuals_of_a_course_add_up_to_the_loss_of_each_colony():
    """Also of a colony that ended before the others, and of one that ended before `since`."""
    state = crowded()
    target = Lasting(TARGETS["bands"], since=1.0)
    run = [state.with_fields(yfp=state.yfp ** (1.0 + k)).replace(time=0.5 * k) for k in range(5)]
    wide = [target.course(s) for s in run]
    assert [w.shape[1] for w in wide[:2]] == [1, 1] and wide[2].shape[1] > 1
    most = wide[2].shape[1]
    history = torch.stack([torch.nn.functional.pad(w, (0, most - w.shape[1])) for w in wide])
    history[3:, 1] = torch.nan
    history[:, 2, 0] = torch.nan
    found = target.residuals(run[-1], history).square().sum(1)
    assert found.numpy() == pytest.approx(target.loss(run[-1], history).numpy(), abs=1e-12)
    at_end = target.residuals(run[-1])
    assert torch.equal(at_end, TARGETS["bands"].residuals(run[-1]))
    notes = torch.stack([target.note(s) for s in run])
    assert target.residuals(run[-1], notes) is None  # of losses alone
    assert Weighted([(target, 1.0), (TARGETS["ring"], 0.5)]).squares
    assert Lasting(Weighted([(TARGETS["ring"], 0.5)]), since=0.0).squares
    assert not Lasting(Burden(), since=0.0).squares
    assert not Weighted([(target, 1.0), (Burden(), 0.5)]).squares


def test_residuals_of_a_sum_of_courses_add_up_to_its_loss():
    """Two patterns that last, from different times on, and one of the end; one sum in another."""
    state = crowded()
    late, early = Lasting(TARGETS["bands"], since=1.0), Lasting(TARGETS["stripe"], since=0.4)
    inner = Weighted([(early, 0.3), (TARGETS["ring"], 0.5)])
    target = Weighted([(late, 2.0), (TARGETS["bands"], 0.7), (inner, 0.6)])
    assert target.squares
    run = [state.with_fields(yfp=state.yfp ** (1.0 + k)).replace(time=0.5 * k) for k in range(5)]
    wide = [target.course(s) for s in run]
    assert len({w.shape[1] for w in wide}) == 3  # from 0.5 h on, and from 1 h on, there is more
    most = max(w.shape[1] for w in wide)
    history = torch.stack([torch.nn.functional.pad(w, (0, most - w.shape[1])) for w in wide])
    history[3:, 1] = torch.nan  # a colony that ended
    found = target.residuals(run[-1], history).square().sum(1)
    assert found.numpy() == pytest.approx(target.loss(run[-1], history).numpy(), abs=1e-12)
    notes = torch.stack([target.note(s) for s in run])
    assert torch.equal(target.loss(run[-1], notes[:3]), target.loss(run[-1], history[:3]))
    assert target.residuals(run[-1], notes) is None  # of losses alone


def test_slopes_of_a_sum_with_a_lasting_pattern_are_those_of_its_loss():
    target = Weighted([(LASTING, 1.0), (EDGES, 0.5)])
    objective = objective_of(lit, TWO, target, cells=8, replicates=2, dtype=torch.float64)
    found = objective.evaluate(POINTS[:1], slopes=True)
    assert objective.least_squares
    step = np.array([2e-4, 0.0])
    more, less = (objective.evaluate(POINTS[:1] + s).loss for s in (step, -step))
    assert found.slopes.gradient[:, 0] == pytest.approx((more - less) / 4e-4, rel=0.02)
    parts = [
        objective_of(lit, TWO, part, cells=8, replicates=2, dtype=torch.float64)
        for part in (LASTING, EDGES)
    ]
    lasting, end = (o.evaluate(POINTS[:1], slopes=True).slopes.curvature for o in parts)
    assert found.slopes.curvature == pytest.approx(lasting + 0.5 * end, rel=1e-9)


def test_a_descent_finds_a_pattern_that_lasts():
    search = Search(
        lit, TWO, LASTING, cells=8, replicates=2, method=Local(starts=1, first=4), finals=None
    )
    best = search.run(120, progress=False)
    lowest = min(search.objective.evaluate(np.array([[u, v] for u in GRID for v in GRID])).loss)
    assert best.loss < lowest + 1e-4


@pytest.mark.parametrize("target", [EDGES, LASTING], ids=["at the end", "lasting"])
def test_slopes_do_not_depend_on_the_batch(target):
    """Each colony alone, and all in one batch, in which larger colonies stand: the same bits."""
    task = objective_of(lit, TWO, target, cells=30, replicates=4).task
    values = [task.space.values(point) for point in POINTS]
    turns = [along(task.space, point) for point in POINTS]

    def slopes(rows, streams):
        part = [values[k] for k in rows], len(streams), 1.0, 1, [turns[k] for k in rows]
        (item,) = cut_work_items(task, *part)
        return run_work_item(task, item, streams, 1.0).slopes

    whole = slopes([0, 1], (0, 1, 2, 3))
    for row in range(2):
        for k in range(4):
            alone = slopes([row], (k,))
            assert np.array_equal(alone.gradient[0], whole.gradient[4 * row + k])
            assert np.array_equal(alone.curvature[0], whole.curvature[4 * row + k])


def test_parameters_with_levels_have_no_slope():
    parameters = [TWO[0], Parameter("decay", 1, 4, whole=True)]
    objective = objective_of(lit, parameters, EDGES, cells=6, replicates=2)
    found = objective.evaluate(POINTS, slopes=True)
    assert found.copies == 1
    assert (found.slopes.gradient[:, 1] == 0).all() and (found.slopes.gradient[:, 0] != 0).all()


def test_where_growth_depends_on_the_design_there_are_differences():
    parameters = [Parameter("rate", 0.5, 2.0), Parameter("make", 0.1, 10.0, log=True)]
    objective = objective_of(paced, parameters, EDGES, until=3.0, replicates=2)
    assert "growth depends on the design" in objective.why_differences
    found = objective.evaluate(POINTS, slopes=True)
    assert found.copies == 5 and np.isnan(found.slopes.curvature).all()
    assert found.losses.shape == (2, 2) and len(found.values) == 2
    assert found.loss == pytest.approx(objective.evaluate(POINTS).loss, rel=1e-6)
    step = np.array([0.0, 0.01])
    more, less = (objective.evaluate(POINTS + s).loss for s in (step, -step))
    assert found.slopes.gradient[:, 1] == pytest.approx((more - less) / 0.02, rel=1e-6)
    assert not found.reasons and (found.slopes.gradient != 0).all()


def test_there_is_no_difference_to_a_colony_that_failed():
    """After 0.5 h none has the cells of a pattern."""
    parameters = [Parameter("rate", 0.5, 2.0), Parameter("make", 0.1, 10.0, log=True)]
    objective = objective_of(paced, parameters, EDGES, until=0.5, replicates=2)
    found = objective.evaluate(POINTS, slopes=True)
    assert len(found.reasons) == 4 and np.isnan(found.slopes.gradient).all()


def test_derivatives_by_nothing_are_refused():
    parameters = [Parameter("decay", 1, 4, whole=True), Choice("make", (1.0, 2.0))]
    objective = objective_of(lit, parameters, EDGES, cells=4, replicates=1)
    with pytest.raises(tf.InputError, match="every parameter is whole or a choice"):
        objective.evaluate(POINTS, slopes=True)


# --- the method ----------------------------------------------------------------------------------


def descend(local, function, dimensions=3, batches=120, residuals=True):
    """All points that a local search asks for, their losses, and the colonies that it took. A
    function gives residuals and their Jacobian at a point."""
    local.start(Room((None,) * dimensions), 1, 1)
    points, losses, cost = [], [], 0
    for _ in range(batches):
        batch = local.ask()
        found = [function(p) for p in batch.points]
        loss = np.array([float(r @ r) for r, _ in found])
        if batch.slopes:
            curvature = np.array([2 * j.T @ j for _, j in found])
            if not residuals:
                curvature = np.full_like(curvature, np.nan)
            gradient = np.array([2 * j.T @ r for r, j in found])
            local.tell(batch, loss, Slopes(gradient, curvature))
        else:
            local.tell(batch, loss)
        cost += len(loss) * (dimensions if batch.slopes else 1)
        points += list(batch.points)
        losses += loss.tolist()
    return np.array(points), np.array(losses), cost


def valley(point):
    """Rosenbrock's function, its least value 0 at (0.6, 0.36) and the third coordinate 0.5."""
    x, y, z = point
    j = np.array([[-20 * x, 10.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    return np.array([10 * (y - x * x), 0.6 - x, z - 0.5]), j


@pytest.mark.parametrize("residuals, least", [(True, 1e-12), (False, 1e-6)])
def test_it_finds_the_bottom_of_a_bent_valley(residuals, least):
    _, losses, _ = descend(Local(starts=2), valley, residuals=residuals)
    assert losses.min() < least


@pytest.mark.parametrize("replicates", [1, 3, 4])
def test_slopes_of_few_replicates_come_first_and_of_more_where_they_mislead(replicates):
    """The slopes point the wrong way, but for those of all replicates."""
    centre = np.array([0.3, 0.6, 0.4])
    local = Local(starts=1, first=4)
    local.start(Room((None,) * 3), 1, replicates)
    seen, losses = [], []
    for _ in range(30):
        batch = local.ask()
        apart = batch.points - centre
        loss = (apart**2).sum(1)
        if batch.slopes:
            seen.append(batch.replicates)
            right = 1.0 if batch.replicates == replicates else -1.0
            local.tell(batch, loss, Slopes(2 * right * apart, 2 * np.eye(3)[None]))
        else:
            assert batch.replicates is None
            losses.append(loss.min())
            local.tell(batch, loss)
    assert list(dict.fromkeys(seen)) == {1: [1], 3: [1, 2, 3], 4: [1, 2, 4]}[replicates]
    assert min(losses) < 1e-12


@pytest.mark.parametrize("replicates", [8, 16])
def test_a_descent_recovers_from_many_slopes_that_mislead(replicates):
    """Only the slopes of all replicates are right. The lengths of steps that the others have
    shortened are forgotten with them."""
    local = Local(starts=1)
    local.start(Room((None,)), 1, replicates)
    local.know(np.array([[0.5]]), np.array([0.16]))
    for _ in range(40):
        batch = local.ask()
        apart = batch.points[:1] - 0.9
        if batch.slopes:
            right = 1.0 if batch.replicates == replicates else -1.0
            local.tell(batch, (apart**2).sum(1), Slopes(2 * right * apart, 2 * np.eye(1)[None]))
        else:
            local.tell(batch, (apart**2).sum(1))
        if local.idle:
            break
    assert local.idle and abs(apart).max() < 1e-3


def test_a_corner_is_not_grown_again():
    """Where bounds hold every parameter, the loss there is known."""
    local = Local(starts=1)
    local.start(Room((None,) * 2), 1, 8)
    local.know(np.zeros((1, 2)), np.array([1.0]))
    for seen in (1, 2, 4, 8):
        batch = local.ask()
        assert batch.slopes and batch.replicates == seen and not batch.points.any()
        local.tell(batch, np.ones(1), Slopes(np.ones((1, 2)), np.eye(2)[None]))
    assert local.idle


def test_slopes_of_few_replicates_are_enough_while_they_lead_down():
    local = Local(starts=1, first=4)
    local.start(Room((None,) * 3), 1, 4)
    for _ in range(7):
        batch = local.ask()
        apart = batch.points - 0.3
        assert not batch.slopes or batch.replicates == 1
        slopes = Slopes(2 * apart, 2 * np.eye(3)[None])
        local.tell(batch, (apart**2).sum(1), *([slopes] if batch.slopes else []))
    assert not batch.slopes and (np.abs(batch.points - 0.3) < 1e-4).all()


def test_it_stops_at_a_bound():
    target = np.array([0.3, 1.4, -0.2])
    points, losses, _ = descend(Local(starts=1), lambda p: (p - target, np.eye(3)), batches=20)
    best = points[losses.argmin()]
    assert best == pytest.approx([0.3, 1.0, 0.0], abs=1e-4)


def test_derivatives_that_mislead_end_a_descent():
    """The slopes point the wrong way: a new start is taken, and the bounds still hold."""
    wrong = lambda p: (p - 0.5, -np.eye(3))
    local = Local(starts=1, first=8)
    points, _, _ = descend(local, wrong, batches=30)
    ends = {d.over for d in local._descents if d.over}
    assert ends <= {"derivatives mislead"}
    # eight first designs, of which two are descended from; each gives up after four misses
    assert len(np.unique(points, axis=0)) > 16


def test_a_derivative_that_is_no_number_ends_a_descent():
    def broken(point):
        j = np.eye(3) * (np.nan if point[0] > 0.5 else 1.0)
        return point - 0.2, j

    points, losses, _ = descend(Local(starts=2, first=8), broken, batches=20)
    assert np.isfinite(points).all() and losses.min() < 1e-6


def test_a_replicate_that_does_not_count_may_lack_slopes():
    slopes = Slopes(np.array([[1.0, 2.0], [np.nan, 0.0]]), np.full((2, 2, 2), np.nan))
    slopes.curvature[0] = np.eye(2)
    found = slopes.reduced(np.array([[1.0, 0.0]]))
    assert found.gradient.tolist() == [[1.0, 2.0]] and found.curvature.tolist() == [
        [[1.0, 0.0], [0.0, 1.0]]
    ]


def test_colonies_that_cannot_be_scored_have_no_slope():
    objective = objective_of(lit, TWO, EDGES, cells=40, until=0.5, replicates=1)
    found = objective.evaluate(POINTS, slopes=True)
    assert len(found.reasons) == 2 and (found.slopes.gradient == 0).all()
    assert np.isnan(found.slopes.curvature).all()


def test_a_search_with_slopes_resumes(tmp_path):
    make = lambda: Search(
        lit, TWO, EDGES, cells=6, replicates=2, method=Local(starts=2, first=4), finals=None
    )  # fmt: skip
    whole = make()
    whole.run(colonies=60, progress=False)
    first = make()
    first.run(colonies=20, study=tmp_path / "a.h5", progress=False)
    again = make()
    best = again.run(colonies=60, study=tmp_path / "a.h5", progress=False)
    assert best.loss == whole.best().loss
    kept = Study.read(tmp_path / "a.h5")
    assert [e.copies for e in kept.entries] == [e.copies for e in whole.study.entries]
    assert kept.colonies == whole.study.colonies
    # 4 first designs × 2 replicates, the slopes of 2 of them × 1 replicate × 2 parameters, and the
    # losses where they lead × 2 replicates
    assert [e.colonies for e in kept.entries][:3] == [8.0, 4.0, 4.0]
    for one, other in zip(kept.entries, whole.study.entries, strict=True):
        assert (one.slopes is None) == (other.slopes is None)
        if one.slopes is not None:
            assert (one.slopes.gradient == other.slopes.gradient).all()


def test_a_search_by_derivatives_reaches_what_a_plain_one_reaches():
    """The loss is flat along a valley of equal levels; both find it, derivatives at once."""
    plain = Search(lit, TWO, EDGES, cells=8, replicates=2, method="sobol")
    local = Search(lit, TWO, EDGES, cells=8, replicates=2, method=Local(starts=2, first=8))
    assert local.run(colonies=80, progress=False).loss <= plain.run(80, progress=False).loss


def slowed(make=1.0, decay=1.0, load="slow"):
    """With one option growth depends on the circuit, with the other it does not."""

    def update(cells):
        cells.growth_rate = 2.0 / (1.0 + 0.1 * cells.gfp)

    scene = lit(make, decay)
    if load == "none":
        return scene
    others = (tf.Division(length=tf.Uniform(3.0, 4.0)), *scene.effects[2:])
    return tf.Scene(tf.Growth(), tf.Rules(update), *others, dt=scene.dt)


@pytest.mark.parametrize("options", [("slow", "none"), ("none", "slow")])
def test_one_option_without_exact_derivatives_is_enough(options):
    parameters = [*TWO, Choice("load", options)]
    objective = objective_of(slowed, parameters, EDGES, cells=8, replicates=1)
    assert "growth depends on the design" in objective.why_differences
    assert not objective.least_squares
    found = objective.evaluate(np.array([[0.3, 0.6, 0.25], [0.3, 0.6, 0.75]]), slopes=True)
    assert not found.reasons and (found.slopes.gradient[:, :2] != 0).all()


def slowed_together(make=1.0, decay=1.0, load="slow", site="plasmid"):
    """Growth depends on the circuit with both first options together only."""
    both = load == "slow" and site == "plasmid"
    return slowed(make, decay, "slow" if both else "none")


TOGETHER = [*TWO, Choice("load", ("slow", "none")), Choice("site", ("plasmid", "genome"))]


def test_options_together_without_exact_derivatives_are_enough():
    objective = objective_of(slowed_together, TOGETHER, EDGES, cells=8, replicates=1)
    assert not objective.task.tried.why_rough  # none of them alone
    assert "growth depends on the design" in objective.why_differences
    assert not objective.least_squares
    found = objective.evaluate(np.array([[0.3, 0.6, 0.25, 0.25]]), slopes=True)
    assert not found.reasons and (found.slopes.gradient[:, :2] != 0).all()


def test_options_that_exclude_each_other_are_not_tried_together():
    def genome_only(values):
        return {"site": "genome"} if values["load"] == "slow" else {}

    choices = [
        Choice("load", ("slow", "none"), resolve=genome_only),
        Choice("site", ("genome", "plasmid"), resolve=genome_only),
    ]
    objective = objective_of(slowed_together, [*TWO, *choices], EDGES, cells=8, replicates=1)
    assert not objective.why_differences and objective.least_squares


def test_a_structure_that_was_not_tried_has_no_slope_rather_than_a_wrong_one(monkeypatch):
    monkeypatch.setattr(scene_family, "MOST_TOGETHER", 0)
    objective = objective_of(slowed_together, TOGETHER, EDGES, cells=8, replicates=1)
    points = np.array([[0.3, 0.6, 0.25, 0.25], [0.3, 0.6, 0.75, 0.25]])
    found = objective.evaluate(points, slopes=True)
    assert np.isnan(found.slopes.gradient[0]).all()
    assert np.isfinite(found.slopes.gradient[1]).all()
    assert not found.reasons
    assert found.losses == pytest.approx(objective.evaluate(points).losses, abs=1e-5)
