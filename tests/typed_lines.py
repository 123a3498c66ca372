"""Lines of users that type checkers must accept: `make types` reads them, and nothing runs them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

import torchfilm as tf
from design import Parameter, Ring, Search


def rates(u, s, p, cell):
    return {"gfp": p.a - u.gfp}


ahl = tf.Signal([10.0, 20.0], decay=tf.PerColony([1.0, 2.0]), source=np.array([1.0, 2.0]))
faces = tf.Robin(tf.PerColony([1.0, 2.0]), transfer=[1.0, 2.0]), tf.Dirichlet([1.0, 2.0])
medium = tf.Medium(
    ahl=ahl, box=((0, 0), (10, 10)), spacing=4.0, boundary=tf.BoundaryConditions(x=faces)
)
corners = [[0.0, 0.0], [10.0, 10.0]]
others = tf.Medium(ahl=ahl, box=corners, spacing=4.0), tf.Medium(box=np.array(corners), spacing=1.0)
pulse = tf.Schedule({0: 0.0, 1: 2.0})
changing = (
    tf.Circuit(rates, species="gfp", a=pulse), tf.Lysis(rate=pulse), tf.Motility(speed=pulse),
    tf.Growth(rate=np.linspace(0.5, 1.0, 2)), tf.Rules(parameters={"k": np.array([1.0, 2.0])}),
)  # fmt: skip


@dataclass(frozen=True, eq=False)
class Ageing(tf.Effect):
    lifetime: tf.Value = tf.physical(2.0, unit="h", above=0.0)

    def step(self, state: tf.State, dt: float, values: tf.Values) -> tf.State:
        return state.with_fields(age=state.age + dt / values.lifetime.of_cells(state))


def starve(cells: tf.CellsView) -> None:
    cells.remove(cells.length < 1.0)


effects = (
    Ageing([0.5, 5.0]),
    Ageing({0: 1.0, 1: 2.0}),
    Ageing(tf.Normal(2.0, 0.1)),
    tf.Rules(starve),
)
walls = [tf.Plane(z=[0.0, 1.0], facing="+z"), tf.Sphere((0.0, 0.0, 9.0), tf.PerColony([1.0, 2.0]))]
scene = tf.Scene(
    tf.Growth(rate=tf.LogNormal([1.0, 2.0], 0.1)),
    tf.Division(length=tf.PerColony([4.0, 5.0])),
    tf.Mechanics(length_drag=[1e3, 1e4], walls=walls),
    tf.Circuit(rates, species="gfp", a=[1.0, 2.0]),
    medium,
    founders=tf.Cells([[0.0, 0.0, 1.0]], [[1.0, 0.0, 0.0]], length=3),
)
for state in tf.simulate(scene, until=1.0, dt=0.05, colonies=2, seed=3):
    means: list[float] = state.species.mean(0).tolist()
*_, last = tf.simulate(scene, until=1.0)
some = last.select(range(1)).put(np.array([0]), last, range(1))
rings = tf.measure.profile(some, "gfp", np.linspace(0.0, 10.0, 5))
search = Search(
    "boundary_detector",
    target=Ring("yfp", radius=3.0, width=2.0),
    parameters=[Parameter("k3", 0.1, 10.0)],
)
best = search.run(200)
loss: float = best.loss
best.save("best.json")
tf.Growht(rate=1.0)  # type: ignore[attr-defined]
tf.Growth(raet=1.0)  # type: ignore[call-arg]
lacking = tf.Results("run.h5").no_such_name  # type: ignore[attr-defined]
