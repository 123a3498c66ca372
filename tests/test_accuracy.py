"""The work–precision studies, run with few settings: orders that theory gives, fronts, the defaults
among the points, and references that are independent."""

from __future__ import annotations

import csv
import itertools
import math
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.sparse.linalg import expm_multiply

import torchfilm as tf

PLACES = [str(Path(__file__).parent.parent / "experiments" / "accuracy")]


@pytest.fixture(scope="module")
def rooms():
    """The modules of the studies, under the names by which they import each other; taken away
    again, since these are names that others may bear."""
    before, known = list(sys.path), set(sys.modules)
    sys.path[:0] = PLACES
    import circuits
    import signals
    import splitting
    import study

    with torch.no_grad(), pytest.MonkeyPatch.context() as patch:
        # no test reads how long a run takes: one is timed, of the cells once
        patch.setattr(study.timed, "__defaults__", (1,))
        patch.setattr(circuits, "COPIES", 1)
        patch.setattr(splitting, "COLONIES", 1)
        yield {"circuits": circuits, "signals": signals, "splitting": splitting, "study": study}
    sys.path[:] = before
    for name in {"circuits", "signals", "splitting", "study"} - known:
        del sys.modules[name]


@pytest.fixture(scope="module")
def found(rooms):
    """All studies by name, quickly."""
    return {
        s.name: s
        for group in ("circuits", "signals", "splitting")
        for s in rooms[group].studies(True)
    }


def errors(study, series: str, error: str) -> list[float]:
    """Of one series, in the order in which they were run."""
    return [p.errors[error] for p in study.points if p.series == series]


@pytest.mark.slow
def test_every_study_has_its_default_and_a_front_that_falls(found):
    for study in found.values():
        assert sum(p.default for p in study.points) == 1, study.name
        assert all(p.seconds > 0 and p.work > 0 for p in study.points)
        for error in study.shown:
            front = study.front(error)
            assert front, (study.name, error)
            work, off = [p.work for p in front], [p.errors[error] for p in front]
            assert work == sorted(work) and all(a > b for a, b in itertools.pairwise(off))
            assert not any(
                p.work <= q.work and p.errors[error] < q.errors[error]
                for q in front
                for p in study.points
            )


@pytest.mark.slow
def test_orders_of_the_circuits(found):
    """Within a quarter of the methods' own; Lux crosses its membrane at 450/h, so that Euler's
    shorter steps alone get there."""
    orders = found["circuits_toggle"].orders("relative error")
    assert orders["steps of euler"] == pytest.approx(1, abs=0.25) and orders[
        "steps of rk4"
    ] == pytest.approx(4, abs=0.25)
    lux = [p for p in found["circuits_lux"].points if p.series == "steps of euler"]
    assert [math.isfinite(p.errors["relative error"]) for p in lux] == [False, False, True]
    assert all(("fails" in p.setting) != math.isfinite(p.errors["relative error"]) for p in lux)
    # dilution and rates in turns
    for order in found["circuits_growth"].orders("relative error").values():
        assert order == pytest.approx(2, abs=0.25)


@pytest.mark.slow
def test_tolerances_of_the_circuits_are_kept(found):
    """All in one step a hundredth of the tolerance leaves at most a twentieth of the error, down to
    what is asked for times ten."""
    for name in ("circuits_toggle", "circuits_lux"):
        series = errors(found[name], "rtol, all in one step", "relative error")
        assert all(b < a / 20 for a, b in itertools.pairwise(series)), name
        assert all(e < 10 * rtol for e, rtol in zip(series, (1e-2, 1e-4, 1e-6), strict=True)), name


@pytest.mark.slow
def test_transport_in_time(found):
    """The exponential and the series are exact against a matrix that knows nothing of them, flow
    and open faces included; implicit of order 1, which Strang halves."""
    flow, obstacle = found["signals_flow"], found["signals_obstacle"]
    assert max(errors(flow, "Δt, exponential", "relative error")) < 1e-12
    assert max(errors(obstacle, "Δt, series", "relative error")) < 1e-12
    for study in (flow, obstacle):
        assert max(errors(study, "Δt, default method, float32", "relative error")) < 1e-5
    for study in (flow, obstacle):
        turns, once = (
            errors(study, f"Δt, implicit{more}", "relative error") for more in ("", ", lie")
        )
        assert turns[1] / turns[2] == pytest.approx(2, rel=0.15)
        # two of Δt/2 are a step of half the size
        assert turns[:-1] == pytest.approx(once[1:], rel=1e-9)
        for kind in ("Δt, implicit", "Δt, euler"):
            assert max(errors(study, kind, "below zero")) <= 0
        paper = errors(study, "Δt, crank_nicolson", "relative error")
        assert paper[1] / paper[2] == pytest.approx(4, rel=0.15)
        assert max(errors(study, "Δt, crank_nicolson", "below zero")) > 1e-3


@pytest.mark.slow
def test_transport_in_space(found):
    """Order 2 where the flow across a voxel is slow beside diffusion; where it is fast, upwinding
    smears: order 1 is approached from below."""
    orders = [
        found[f"signals_space{more}"].orders("relative error")["spacing"]
        for more in ("", "_flow", "_fast")
    ]
    assert orders[0] == pytest.approx(2, abs=0.1) and orders[1] == pytest.approx(2, abs=0.15)
    assert 0.3 < orders[2] < 1.1
    own = errors(found["signals_cell"], "spacing", "own reading")
    assert own[1] > 2 * own[0]  # finer, and it grows at least as 1/h


@pytest.mark.slow
def test_splitting(found):
    """Against the whole system at once: with a voxel to itself a cell's species and the signal are
    of order 2 by Strang and 1 by Lie; off the middle the pool, which is not what the cell reads,
    leaves the species at order 1 by either, and the signal at 2 by Strang.
    """
    alone, growing = (found[f"splitting_{n}"] for n in ("alone", "growing"))
    order = lambda study, kind, error: study.orders(error)[f"Δt, {kind}, rtol 1e-05, float64"]
    for error in ("species", "signal"):
        assert order(alone, "strang", error) == pytest.approx(2, abs=0.25)
        assert order(alone, "lie", error) == pytest.approx(1, abs=0.25)
    assert order(growing, "strang", "species") == pytest.approx(1, abs=0.2) and order(
        growing, "strang", "signal"
    ) == pytest.approx(2, abs=0.3)
    for study in (alone, growing):
        lie, strang = (
            errors(study, f"Δt, {kind}, rtol 1e-05, float64", "signal")
            for kind in ("lie", "strang")
        )
        assert all(a > 4 * b for a, b in zip(lie, strang, strict=True))


@pytest.mark.slow
def test_from_an_even_medium_lie_and_strang_are_one_course(rooms):
    """Transport leaves an even medium as it is, and Strang's course is then Lie's, looked at half a
    transport earlier: the same species, another signal."""
    room = rooms["splitting"]
    case = room.cases()[1]
    ends = []
    for kind in ("lie", "strang"):
        scene = room.scene_of(case, kind, 1e-4)
        model = scene.bind(dtype=torch.float64)
        state = model.start()
        state = state.with_fields(
            **{tf.state.OUTSIDE + "ahl": torch.zeros_like(state.signals["ahl"])}
        )
        ends.append(rooms["circuits"].advance(model, state, 0.1, 5))
    assert ends[0].luxi.tolist() == pytest.approx(ends[1].luxi.tolist(), rel=1e-12)
    assert float((ends[0].signals["ahl"] - ends[1].signals["ahl"]).abs().max()) > 1e-3 * float(
        ends[1].signals["ahl"].max()
    )


def test_the_assembled_matrix(rooms):
    """Nothing is lost between shut faces, and a plain Laplacian is what is left without flow."""
    room = rooms["signals"]
    matrix = room.assembled((5, 4), 2.0, 3.0, 0.0)
    assert np.abs(matrix.sum(0)).max() < 1e-14 and (matrix - matrix.T).nnz == 0
    assert matrix[6, 7] == pytest.approx(3.0 / 4.0) and matrix[6, 10] == pytest.approx(3.0 / 4.0)
    flowing = room.assembled(
        (5, 4), 2.0, 3.0, 0.0, lambda x: np.broadcast_to([7.0, 0.0], x.shape), True
    )
    lost = -np.asarray(flowing.sum(0)).reshape(5, 4)
    # what flows out at the far face
    assert lost[:-1] == pytest.approx(0, abs=1e-14) and lost[-1] == pytest.approx(3.5)
    assert float(expm_multiply(flowing, np.ones(20)).min()) > 0


def test_equations_are_those_of_the_scene(rooms):
    """The repressilator here is the ready scene's."""
    room = rooms["circuits"]
    problem = room.problems()[0]
    starts = {n: float(v[0]) for n, v in problem.starts.items()}
    ready = next(
        e for e in tf.scenes.repressilator(noise=False).effects if isinstance(e, tf.Circuit)
    )
    same = tf.Circuit(
        ready.rates[next(iter(ready.rates))],
        species=ready.species,
        initial=starts,
        **ready.parameters,
    )
    ours = tf.Circuit(problem.rates, species=ready.species, initial=starts, **problem.parameters)
    ends = [tf.Scene(c, founders=tf.Cells([[0.0, 0.0]], [[1.0, 0.0]])) for c in (same, ours)]
    models = [scene.bind(dtype=torch.float64) for scene in ends]
    last = [room.advance(model, model.start(), 0.05, 4) for model in models]
    for name in ready.species:
        assert float(last[0].fields[name]) == pytest.approx(float(last[1].fields[name]), rel=1e-8)


@pytest.mark.slow
def test_what_is_written(found, rooms, tmp_path):
    """A line a point in the CSV and the table, the default marked once."""
    tell = rooms["study"]
    study = found["circuits_toggle"]
    tell.write_csv(study, tmp_path / "one.csv")
    with (tmp_path / "one.csv").open() as file:
        lines = list(csv.DictReader(file))
    assert len(lines) == len(study.points) and [r["default"] for r in lines].count("1") == 1
    assert [float(r["relative error"]) for r in lines] == pytest.approx(
        [p.errors["relative error"] for p in study.points], rel=1e-3
    )
    assert tell.table(study).count("(default)") == 1
    tell.plot(study, tmp_path / "one.png")
    assert (tmp_path / "one.png").stat().st_size > 10_000
