"""Scripts in the style of CellModeller 4 run unchanged: on columns or cell by cell, alike in any
batch, and after a restart."""

from __future__ import annotations

import pickle
import random
import subprocess
import sys
import warnings

import numpy as np
import pytest
import torch
from cell_scripts import DIVIDE, GROWS, HEAD, INIT, SETUP, UPDATE, signalling, written

import torchfilm as tf
from torchfilm.cli.scene_files import load_scene

SLOW = "ignore:.*runs cell by cell:UserWarning"


def grown(scene: tf.Scene, **options) -> tf.State:
    *_, state = tf.simulate(scene, **{"until": 3.0, "seed": 3, **options})
    return state


def assert_alike(one: tf.State, other: tf.State) -> None:
    assert one.cells == other.cells
    assert torch.equal(one.position, other.position)
    for name in ("color", "targetVol", "plasmids", "growth_rate", "cell_type"):
        assert torch.equal(one.fields[name], other.fields[name]), name


def test_a_script_is_what_it_asks_for(tmp_path):
    scene = tf.from_cellmodeller(written(tmp_path, GROWS))
    assert (scene.name, scene.dt, scene.dim) == ("model", 0.05, 2)
    mechanics = next(e for e in scene.effects if isinstance(e, tf.Mechanics))
    assert float(mechanics.length_drag) == 50
    assert scene.founders.length.tolist() == [3.5, 2.5]
    state = grown(scene)
    assert state.cells > 8
    assert int(state.plasmids.sum()) == 6 * state.cells  # each division shares 12 copies
    assert bool(((state.targetVol >= 3) & (state.targetVol <= 3.5)).all())
    assert torch.allclose(state.color[:, 2], torch.tensor(0.2, dtype=torch.float64))


def test_columns_and_the_loop_give_the_same_bits(tmp_path):
    path = written(tmp_path, GROWS)
    columns = tf.from_cellmodeller(path, loop="columns")
    with pytest.warns(UserWarning, match="cell by cell"):
        cells = tf.from_cellmodeller(path, loop="cells")
    assert_alike(grown(columns), grown(cells))


@pytest.mark.parametrize("loop", ["columns", "cells"])
@pytest.mark.filterwarnings(SLOW)
def test_a_colony_is_the_same_in_any_batch(tmp_path, loop):
    scene = tf.from_cellmodeller(written(tmp_path, GROWS), loop=loop)
    many = grown(scene, colonies=3)
    mine = many.select([2])
    *_, alone = tf.simulate(scene, scene.bind(1, seed=3, streams=[2]).start(), until=3.0)
    assert_alike(mine, alone)
    assert not torch.equal(many.select([0]).targetVol[:1], mine.targetVol[:1])


def test_a_run_leaves_the_random_numbers_of_others_alone(tmp_path):
    scene = tf.from_cellmodeller(written(tmp_path, GROWS))
    random.seed(1)
    np.random.seed(1)  # noqa: NPY002
    wanted = random.random(), np.random.random()  # noqa: NPY002
    random.seed(1)
    np.random.seed(1)  # noqa: NPY002
    grown(scene, until=1.0)
    assert (random.random(), np.random.random()) == wanted  # noqa: NPY002


@pytest.mark.parametrize("loop", ["columns", "cells"])
@pytest.mark.filterwarnings(SLOW)
def test_a_run_resumes_bit_for_bit(tmp_path, loop):
    text = GROWS.replace("cell.plasmids / 12.0", "cell.effGrowth")
    scene = tf.from_cellmodeller(written(tmp_path, text), loop=loop)
    whole = grown(scene)
    for _ in tf.simulate(scene, until=1.5, seed=3, record=tf.Recorder(tmp_path / "a.h5", scene)):
        pass
    with tf.Results(tmp_path / "a.h5") as results:
        half = results.state(tf.from_cellmodeller(tmp_path / "model.py", loop=loop))
    *_, end = tf.simulate(scene, half, until=3.0)
    assert_alike(whole, end)
    assert torch.equal(whole.effGrowth, end.effGrowth)


def test_the_command_knows_a_script(tmp_path):
    written(tmp_path, GROWS)
    made = subprocess.run(
        [sys.executable, "-m", "torchfilm", "run", "model.py", "--cells", "8", "--out", "a.h5"],
        cwd=tmp_path, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert made.returncode == 0, made.stderr
    assert (tmp_path / "a.png").stat().st_size > 5000
    with tf.Results(tmp_path / "a.h5") as results:
        assert results.frame(-1)["color"].shape[1] == 3
    assert not [name for name in sys.modules if name.split(".")[0] == "CellModeller"]


def test_settings_of_the_command(tmp_path):
    written(tmp_path, GROWS)
    scene = load_scene(str(tmp_path / "model.py"), {"contacts": "bilateral"})
    assert any(getattr(e, "contacts", "") == "bilateral" for e in scene.effects)
    with pytest.raises(tf.InputError, match="loop = 'fast' is not allowed"):
        load_scene(str(tmp_path / "model.py"), {"loop": "fast"})


# --- what CellModeller keeps of cells ------------------------------------------------------------


def test_what_cells_have(tmp_path):
    """Age in steps, growth of the last step, length at birth, and contacts."""
    update = """
def update(cells):
    assert all(key == cell.id for key, cell in cells.items())
    for cell in cells.values():
        assert len(cell.pos) == 3 and cell.pos[2] == 0 and cell.volume == cell.length
        far = numpy.linalg.norm(cell.ends[1] - cell.ends[0])
        assert abs(far - cell.length) < 1e-5
        cell.age = cell.cellAge
        cell.grown = cell.strainRate
        cell.first = cell.startVol
        cell.touches = len(cell.neighbours)
        assert all(other in cells for other in cell.neighbours)
        cell.divideFlag = cell.length > cell.targetVol
"""
    setup = SETUP.replace("gamma=50", "gamma=1e6, compNeighbours=True")
    path = written(tmp_path, HEAD + setup + INIT + update + DIVIDE)
    with pytest.warns(UserWarning, match="cell by cell"):
        scene = tf.from_cellmodeller(path)
    states = list(tf.simulate(scene, until=2.0))
    first, last = states[0], states[-1]
    assert set(first.age.tolist()) == set(first.grown.tolist()) == {0}
    assert last.cells > 4 and last.age.max() < 40 and last.age.min() >= 0
    # 1/h, but for a little pressure: exp(0.05) - 1
    assert last.grown[last.age > 0].median() == pytest.approx(np.expm1(0.05), rel=0.02)
    assert bool((last.fields["first"] < 3.6).all())
    assert last.touches.max() >= 1


def test_init_sets_the_length(tmp_path):
    init = INIT + "    cell.length = 2.0 + cell.cellType\n"
    scene = tf.from_cellmodeller(written(tmp_path, HEAD + SETUP + init + UPDATE + DIVIDE))
    assert scene.bind().start().length.tolist() == [2.0, 3.0]


def test_cells_die(tmp_path):
    update = UPDATE + "        if cell.id > 6: cell.deathFlag = True\n"
    path = written(tmp_path, HEAD + SETUP + INIT + update + DIVIDE)
    with pytest.warns(UserWarning, match="deathFlag"):
        scene = tf.from_cellmodeller(path)
    assert grown(scene, until=5.0).cells == 0  # all later cells have a higher id


def test_planes_and_spheres(tmp_path):
    walls = """
    body.addPlane((0, -5, 0), (0, 1, 0), 1.0)
    body.addPlane((0, 0, 1), (0, 0, -1), 1.0)
    body.addSphere((0, 0, 0), 30, 1.0, -1)
"""
    scene = tf.from_cellmodeller(
        written(tmp_path, HEAD + SETUP.rstrip() + walls + INIT + UPDATE + DIVIDE)
    )
    mechanics = next(e for e in scene.effects if isinstance(e, tf.Mechanics))
    plane, sphere = mechanics.walls  # the plane above touches no cell in the plane z = 0
    assert isinstance(plane, tf.Plane) and isinstance(sphere, tf.Sphere) and sphere.inside


def test_jitter_in_z_is_space(tmp_path):
    text = GROWS.replace("jitter_z=False, ", "")
    assert tf.from_cellmodeller(written(tmp_path, text)).dim == 3


# --- species and signals -------------------------------------------------------------------------


@pytest.mark.parametrize(
    "integrator, share", [("CLEulerSigIntegrator", 6), ("CLCrankNicIntegrator", 12)]
)
def test_rates_are_those_of_the_text(tmp_path, integrator, share):
    """A cell that does not grow: dx/dt = 2, and 0.5·4 of signal an hour in units of its voxels."""
    scene = tf.from_cellmodeller(written(tmp_path, signalling(integrator)))
    medium = next(e for e in scene.effects if isinstance(e, tf.Medium))
    assert float(medium.signals["signal0"].diffusion) == 6.0 / share
    assert medium.box == ((-24.0, -24.0, -8.0), (24.0, 24.0, 8.0))  # nodes are centres of voxels
    state = grown(scene, until=1.0)
    assert state.species1.item() == pytest.approx(2.0, rel=1e-5)
    assert state.species0.item() == pytest.approx(4.0, rel=1e-5)
    assert state.signals["signal0"].sum().item() == pytest.approx(2.0, rel=1e-4)
    assert 0 < state.seen.item() < 2.0  # update sees the signal where the cell is


def test_the_options_of_integrators_go_by_their_own_order(tmp_path):
    """CLEulerSigIntegrator has no greensThreshold, which CLCrankNicIntegrator has before regul."""
    for kind, given in (
        ("CLEulerSigIntegrator", "sig, None, 'wrap'"),
        ("CLCrankNicIntegrator", "sig, 1e-9, None, 'wrap'"),
    ):
        text = signalling(kind).replace("sig, boundcond='reflect'", given)
        scene = tf.from_cellmodeller(written(tmp_path, text))
        medium = next(e for e in scene.effects if isinstance(e, tf.Medium))
        faces = medium.signals["signal0"].boundary
        assert {type(f) for f in (*faces.x, *faces.y, *faces.z)} == {tf.Periodic}


def test_growth_dilutes_species(tmp_path):
    scene = tf.from_cellmodeller(written(tmp_path, signalling(rate=1.0)))
    first = scene.bind().start()
    state = grown(scene, until=1.0)
    assert state.species0.item() == pytest.approx(
        4.0 * float(first.volume / state.volume), rel=1e-4
    )


def test_the_equations_can_be_printed(tmp_path):
    scene = tf.from_cellmodeller(written(tmp_path, signalling()))
    circuit = next(e for e in scene.effects if isinstance(e, tf.Circuit))
    assert "to out.signal0 = 64·0.5·species0" in str(circuit.graph)


def test_species_can_be_set_at_division(tmp_path):
    text = signalling(rate=1.0) + (
        "        if cell.length > 4: cell.divideFlag = True\n"
        "def divide(parent, d1, d2):\n    d1.species[:] = 0\n    d2.species = [8, 8]\n"
    )
    scene = tf.from_cellmodeller(written(tmp_path, text))
    for state in tf.simulate(scene, until=0.6):
        if state.cells == 2:
            break
    # after the division they grow for one step
    assert state.species0[0] == 0 and state.species0[1] == pytest.approx(8.0, rel=0.06)


def test_divide_is_called_beside_a_threshold(tmp_path):
    """Where the user gives the scene of a script a Division of another kind."""
    text = (
        HEAD
        + SETUP
        + "def init(cell):\n    cell.gen, cell.growthRate = 0, 1.0\n"
        + "def update(cells):\n    for cell in cells.values(): cell.seen = cell.cellAge\n"
        + "def divide(parent, d1, d2):\n    d1.gen = d2.gen = parent.gen + 1\n"
    )
    scene = tf.from_cellmodeller(written(tmp_path, text))
    effects = [e for e in scene.effects if not isinstance(e, tf.Division)]
    state = grown(scene.replace(*effects, tf.Division(length=4.0)), until=None, cells=8)
    # in steps; the grandmother was born at the start
    assert (state.gen == 2).all() and float(state.cellAge.max()) < 0.6 * state.step


def test_no_warning_for_what_is_plain(tmp_path):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        tf.from_cellmodeller(written(tmp_path, signalling()))


def test_rates_read_the_cell(tmp_path):
    """effGrowth is the mean growth of a step, µm; pos and area are the cell's."""
    text = signalling("CLEulerIntegrator", rate=1.0)
    text = text.replace("sim, 1, 2, 1000, sig, boundcond='reflect'", "sim, 2, 1000")
    text = text.replace("ModuleRegulator(sim), sig, integ", "ModuleRegulator(sim), None, integ")
    text = text.replace("pos=(0, 0, 0), length", "pos=(7, 0, 0), length")
    text = text.replace("rates[1] = k;", "rates[1] = effGrowth > 0.1 ? pos.x : 0.0f;")
    text = text.replace("cell.signals[:] = [0]", "pass").replace(
        "cell.signals[0]", "cell.effGrowth"
    )
    state = grown(tf.from_cellmodeller(written(tmp_path, text)), until=0.5)
    assert state.effGrowth.item() == pytest.approx(3 * np.expm1(0.45) / 9, rel=1e-3)
    assert 2.0 < state.species1.item() < 3.2  # 7 an hour, but for dilution and the first step


def test_first_cells_from_a_table(tmp_path):
    scene = tf.from_cellmodeller(written(tmp_path, GROWS))
    table = {
        "x_um": [0.0],
        "y_um": [0.0],
        "length_um": [2.0],
        "angle_rad": [0.0],
        "plasmids": [4.0],
    }
    state = scene.bind(cells=tf.Cells.from_table(table), dtype=torch.float64).start()
    assert state.plasmids.tolist() == [4] and 3 <= state.targetVol.item() <= 3.5


def test_asymm_and_other_random_numbers(tmp_path):
    update = UPDATE + "        cell.asymm = [2, 1]\n"
    text = HEAD + "generator = numpy.random.default_rng()\n" + SETUP + INIT + update + DIVIDE
    with pytest.warns(UserWarning, match="default_rng has random numbers of its own"):
        scene = tf.from_cellmodeller(written(tmp_path, text))
    with pytest.warns(UserWarning, match="cells divide in the middle"):
        grown(scene, until=1.0)


def test_a_share_that_only_a_later_step_sets_is_not_used_either(tmp_path):
    update = UPDATE.replace("cell.divideFlag = True", "cell.divideFlag = True; cell.asymm = [2, 1]")
    text = HEAD + SETUP + INIT.replace("3 + random", "3.6 + random") + update + DIVIDE
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        scene = tf.from_cellmodeller(written(tmp_path, text), loop="cells")
    with pytest.warns(UserWarning, match="cells divide in the middle"):
        assert grown(scene, until=1.0).cells > 2


KEEPS = """
the_sim = None
count = 0

def setup(sim):
    global the_sim
    the_sim = sim
    sim.init(CLBacterium(sim, jitter_z=False), ModuleRegulator(sim), None, None)
    sim.addCell(cellType=0, pos=(0, 0, 0))

def init(cell):
    cell.targetVol, cell.growthRate, cell.n, cell.k = 3.5, 1.0, 0, 0

def update(cells):
    for id, cell in cells.items():
        cell.n, cell.k = len(the_sim.cellStates), the_sim.stepNum
        if the_sim.stepNum >= 40:
            cell.growthRate = 0.0
        if cell.volume > cell.targetVol:
            cell.divideFlag = True
"""


@pytest.mark.filterwarnings(SLOW)
def test_a_script_that_keeps_sim_reads_the_step_and_the_cells(tmp_path):
    """Growth ends at step 40, in each of two colonies; also after a restart."""
    scene = tf.from_cellmodeller(written(tmp_path, HEAD + KEEPS))
    state = grown(scene, colonies=2)
    assert state.k.tolist() == [59.0] * state.cells and not bool(state.growth_rate.any())
    assert state.n.tolist() == torch.repeat_interleave(state.counts, state.counts).tolist()
    assert state.counts.tolist() == [4, 4]
    half = grown(scene, colonies=2, until=1.5)
    *_, again = tf.simulate(scene.bind(state=half), half, until=3.0)
    assert torch.equal(again.position, state.position) and torch.equal(again.k, state.k)


@pytest.mark.parametrize(
    "line, words",
    [
        ("the_sim.addCell(pos=(9, 0, 0))", "sim.addCell after setup"),
        ("the_sim.dt = 0.1", "sim.dt = … after setup"),
        ("the_sim.stepNum = 0", "sim.stepNum = … is not supported"),
    ],
)
@pytest.mark.filterwarnings(SLOW)
def test_what_cannot_be_set_up_later_is_refused(line, words, tmp_path):
    text = HEAD + KEEPS + f"    if the_sim.stepNum == 3:\n        {line}\n"
    scene = tf.from_cellmodeller(written(tmp_path, text))
    with pytest.raises(tf.SimulationError, match=words):
        grown(scene)


def test_the_cells_are_known_in_update_only(tmp_path):
    text = HEAD + KEEPS + "\ndef divide(parent, d1, d2):\n    d1.n = len(the_sim.cellStates)\n"
    with pytest.raises(tf.InputError, match=r"sim\.cellStates is known in update\(cells\) only"):
        tf.from_cellmodeller(written(tmp_path, text))


@pytest.mark.filterwarnings(SLOW)
def test_a_global_variable_that_one_function_changes_is_said_of_that_one(tmp_path):
    text = HEAD + KEEPS.replace("    for id", "    global count\n    count += 1\n    for id")
    text += "\ndef divide(parent, d1, d2):\n    d1.n = 0\n"
    with pytest.warns(UserWarning, match=r"update\(cells\) changes the global") as caught:
        grown(tf.from_cellmodeller(written(tmp_path, text)))
    assert not any("divide(parent" in str(w.message) for w in caught)


@pytest.mark.filterwarnings(SLOW)
def test_a_negative_type_is_refused(tmp_path):
    text = HEAD + KEEPS.replace("cell.n, cell.k = len", "cell.cellType = -1; cell.n, cell.k = len")
    with pytest.raises(tf.SimulationError, match="cellType = -1: it must be a whole number from 0"):
        grown(tf.from_cellmodeller(written(tmp_path, text), loop="cells"))


def test_a_scene_is_known_again(tmp_path):
    """By what the script says, not by where it lies; and in another process."""
    scene = tf.from_cellmodeller(written(tmp_path, GROWS))
    again = pickle.loads(pickle.dumps(scene))
    assert again.fingerprint == scene.fingerprint
    (tmp_path / "other").mkdir()
    moved = tf.from_cellmodeller(written(tmp_path / "other", GROWS))
    assert moved.fingerprint == scene.fingerprint
    changed = tf.from_cellmodeller(written(tmp_path, GROWS.replace("1.2", "1.3")))
    assert changed.fingerprint != scene.fingerprint
    assert "cell by cell" not in str(tf.explain(scene, seconds=0.0))
