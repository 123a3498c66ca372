"""Signals and circuits in results: what a file gives back, and a colony that goes on bit for bit
from it, alone, or in another batch."""

from __future__ import annotations

import h5py
import numpy as np
import pytest
import torch
from helpers import step
from recorded import assert_same_state

import torchfilm as tf
from torchfilm.tools.checks import InputError

DT, UNTIL, EVERY = 0.05, 1.5, 6
BOX = {"box": ((-8.0, -8.0), (8.0, 8.0)), "spacing": 2.0}


def lux(u, s, p, cell):
    into = p.D1 * (s.ahl - u.ahl) * cell.area
    return {
        "luxi": p.basal + u.ahl**2 / (1 + u.ahl**2) - u.luxi,
        "ahl": p.make * u.luxi + into / cell.volume,
    }, {"ahl": -into}


def body() -> list[tf.Effect]:
    return [tf.Division(length=tf.Uniform(3.0, 3.4)), tf.Mechanics(dim=2)]


def smooth() -> tf.Scene:
    """Constants of circuit and signal per colony, and grids that grow, each with its colony."""
    return tf.Scene(
        tf.Growth(rate=[1.0, 1.5, 2.0]),
        *body(),
        tf.Circuit(
            lux,
            species=("luxi", "ahl"),
            initial={"luxi": tf.Uniform(0.5, 1.0)},
            D1=[1.0, 2.0, 3.0],
            basal=0.1,
            make=2.0,
            daughters="amount",
        ),
        tf.Medium(
            ahl=tf.Signal(diffusion=[10.0, 20.0, 30.0], decay=[0.1, 0.2, 0.3]),
            flow=([1.0, 0.0, -1.0], 0.0),
            outside="grow",
            **BOX,
        ),
        dt=DT,
    )


def leaping() -> tf.Scene:
    """Molecule by molecule, in a box in a reservoir."""
    reactions = [
        tf.parts.constitutive("m", "make"),
        tf.parts.degradation("m", 1.0),
        tf.parts.exchange("m", 1.0),
    ]
    return tf.Scene(
        tf.Growth(rate=1.7),
        *body(),
        tf.Circuit(
            reactions,
            species=("m",),
            initial={"m": 3.0},
            method="tau_leap",
            make=[5.0, 10.0, 20.0],
            molecules_per_unit=[1.0, 2.0, 3.0],
        ),
        tf.Medium(
            m=tf.Signal(diffusion=5.0, reservoir=[0.0, 0.5, 1.0]),
            box=((-2.0, -2.0), (2.0, 2.0)),
            spacing=2.0,
            outside="reservoir",
        ),
        dt=DT,
    )


def typed() -> tf.Scene:
    """Two kinds of cell with circuits of their own, about an obstacle (implicit transport)."""
    exchange = [tf.parts.constitutive("a", "make"), tf.parts.exchange("a", "D1")]
    cells = tf.Cells([[0.0, -1.0], [0.0, 1.0]], [[1.0, 0.0]] * 2, cell_type=[0, 1])
    return tf.Scene(
        tf.Growth(rate=1.3),
        *body(),
        tf.Circuit({0: exchange, 1: taken}, species=("a",), make=[1.0, 2.0, 3.0], D1=1.0, k=2.0),
        tf.Medium(
            a=tf.Signal(diffusion=10.0),
            obstacles=lambda at: at[:, 0] > 12.0,
            box=((-16.0, -16.0), (16.0, 16.0)),
            spacing=4.0,
        ),
        founders=cells,
        dt=DT,
    )


def taken(u, s, p, cell):
    into = p.k * s.a * cell.volume
    return {"a": into / cell.volume - u.a}, {"a": -into}


def fed() -> tf.Scene:
    return tf.Scene(
        tf.Monod("food", rate=[1.0, 1.5, 2.0], half=0.2),
        tf.Growth(),
        *body(),
        tf.Medium(
            food=tf.Signal(diffusion=20.0, initial=[1.0, 2.0, 3.0]),
            boundary=tf.BoundaryConditions(x=tf.Dirichlet([1.0, 2.0, 3.0])),
            outside="grow",
            grows="y",
            depth=1.0,
            box=((-16.0, -8.0), (16.0, 8.0)),
            spacing=4.0,
        ),
        dt=DT,
    )


SCENES = {"smooth": smooth, "molecules": leaping, "types": typed, "food": fed}


@pytest.fixture(params=SCENES)
def make(request):
    return SCENES[request.param]


def record(
    scene: tf.Scene, state: tf.State, path, until: float = UNTIL, **options
) -> list[tf.State]:
    return [
        state,
        *tf.simulate(
            scene, state, until=until, record=tf.Recorder(path, scene, every=EVERY, **options)
        ),
    ]


def assert_same(a: tf.State, b: tf.State) -> None:
    assert_same_state(a, b)
    assert (a.layout is None) == (b.layout is None)
    if a.layout is not None and b.layout is not None:
        for name in ("origin", "shape"):
            assert torch.equal(getattr(a.layout.grid, name), getattr(b.layout.grid, name)), name
        assert a.layout.grid.spacing == b.layout.grid.spacing


def test_a_run_goes_on_from_any_frame_bit_for_bit(make, dtype, tmp_path):
    scene = make()
    states = record(scene, scene.bind(3, seed=7, dtype=dtype).start(), tmp_path / "run.h5")
    assert int(states[-1].counts.max()) >= 4
    again = make()
    with tf.Results(tmp_path / "run.h5") as results:
        for k, step in enumerate(results.steps.tolist()):
            assert_same(results.state(again, k), states[step])
        middle = results.state(again, 2)
    last = list(tf.simulate(again, middle, until=UNTIL))[-1]
    assert_same(last, states[-1])


def test_a_colony_alone_and_in_another_order_is_the_same(make):
    """From the start, and from the middle of a run."""
    scene = make()
    first = scene.bind(3, seed=7).start()
    states = [first, *tf.simulate(scene, first, until=UNTIL)]
    for k, places in ((0, [1]), (0, [2, 0]), (12, [2, 1, 0]), (12, [0])):
        part = list(tf.simulate(scene, states[k].select(places), until=UNTIL))[-1]
        assert_same(part, states[-1].select(places))


def test_appending_is_as_if_never_stopped(tmp_path):
    scene = smooth()
    state = scene.bind(3, seed=7).start()
    record(scene, state, tmp_path / "whole.h5")
    record(scene, state, tmp_path / "two.h5", until=EVERY * 2 * DT)
    with tf.Results(tmp_path / "two.h5") as results:
        middle = results.state(scene)
    record(scene, middle, tmp_path / "two.h5", append=True)
    with tf.Results(tmp_path / "whole.h5") as a, tf.Results(tmp_path / "two.h5") as b:
        assert a.steps.tolist() == b.steps.tolist() and a.signal_names == b.signal_names == ("ahl",)
        for k in range(len(a)):
            for x, y in zip(
                (*a.grid(k), *a.signal("ahl", k), *a.frame(k).values()),
                (*b.grid(k), *b.signal("ahl", k), *b.frame(k).values()),
                strict=True,
            ):
                assert np.array_equal(x, y)


def test_a_half_written_frame_is_not_there(tmp_path):
    """Rows of signals that no frame counts, as a kill leaves them, are gone when a run goes on."""
    scene = smooth()
    states = record(
        scene, scene.bind(2 + 1, seed=7).start(), tmp_path / "run.h5", until=EVERY * 2 * DT
    )
    with h5py.File(tmp_path / "run.h5", "r+") as file:
        for name in ("signals/ahl", "frames/grid/first_voxel"):
            table = file[name]
            table.resize(len(table) + 1, axis=0)
            table[-1] = 12345
    with tf.Results(tmp_path / "run.h5") as results:
        middle = results.state(scene)
    assert_same(middle, states[-1])
    record(scene, middle, tmp_path / "run.h5", append=True)
    record(scene, scene.bind(3, seed=7).start(), tmp_path / "whole.h5")
    with tf.Results(tmp_path / "whole.h5") as a, tf.Results(tmp_path / "run.h5") as b:
        for k in range(len(a)):
            assert all(
                np.array_equal(x, y)
                for x, y in zip(a.signal("ahl", k), b.signal("ahl", k), strict=True)
            )


def test_what_a_file_tells_of_signals(tmp_path):
    scene = smooth()
    states = record(scene, scene.bind(3, seed=7).start(), tmp_path / "run.h5")
    last, grid = states[-1], states[-1].layout.grid
    assert len({*grid.shapes}) > 1, "grids of one shape prove little"
    with tf.Results(tmp_path / "run.h5") as results:
        assert results.signal_names == ("ahl",)
        origin, shape, spacing = results.grid()
        assert (
            np.array_equal(origin, grid.origin.numpy())
            and np.array_equal(shape, grid.shape.numpy())
            and spacing.tolist() == [2.0, 2.0, 2.0]
        )
        found = results.signal("ahl")
        assert [x.shape for x in found] == list(grid.shapes)
        assert np.array_equal(
            np.concatenate([x.reshape(-1) for x in found]), last.signals["ahl"].numpy()
        )
        assert [x.shape for x in results.signal("ahl", 0)] == [(8, 8, 1)] * 3
        table = results.table(-1)
        assert {"luxi", "ahl"} <= set(table) and "circuit_volume" not in table
        assert "circuit_volume" in results.table(-1, internals=True)
        assert np.array_equal(table["out.ahl"], last.contact().found["ahl"].numpy())
        with pytest.raises(InputError, match=r"signal = 'luxi'.*one of ahl"):
            results.signal("luxi")


def test_files_without_a_medium_say_so_and_hold_nothing_of_it(tmp_path):
    scene = tf.Scene(tf.Growth(rate=1.0), *body())
    record(scene, scene.bind(3).start(), tmp_path / "run.h5", until=0.3)
    with h5py.File(tmp_path / "run.h5") as file:
        assert (
            "signals" not in file and "grid" not in file["frames"] and "spacing" not in file.attrs
        )
    with tf.Results(tmp_path / "run.h5") as results:
        assert results.signal_names == ()
        with pytest.raises(InputError, match="no medium"):
            results.grid()
        with pytest.raises(InputError, match="none: the scene has no medium"):
            results.signal("ahl")
        with pytest.raises(InputError, match=r"it lacks.*out\.ahl"):
            results.state(smooth())


def test_a_file_with_a_medium_is_not_of_a_scene_without(tmp_path):
    scene = smooth()
    record(scene, scene.bind(3).start(), tmp_path / "run.h5", until=0.3)
    with tf.Results(tmp_path / "run.h5") as results:
        with pytest.raises(InputError, match=r"with a Medium \(ahl\)"):
            results.state(tf.Scene(tf.Growth(rate=[1.0] * 3), *body()))
        with pytest.raises(InputError, match=r"it lacks 'm', 'out.m'"):
            results.state(leaping())


def test_a_state_moves_to_another_device_with_its_grids(device):
    scene = smooth()
    state = scene.bind(3, device=device).start()
    back = step(scene, state, DT).to("cpu")
    assert back.layout.grid.origin.device.type == "cpu" and back.signals["ahl"].device.type == "cpu"
    assert step(scene, back, DT).signals["ahl"].shape == back.signals["ahl"].shape
