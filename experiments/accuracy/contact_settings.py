"""Settings of the contact mechanics that the studies compare, and how they run one setting.

Work is the number of contact rows that products with J and its transpose read. It does not include
finding the contacts.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from row_counter import RowCounter
from study import timed

import torchfilm as tf

WORK = "contact rows read"
DT = 0.025  # h, the default step of a scene
DIAMETER = 1.0  # µm, of all cells in these studies
SHORT = 0.1  # s; longer runs are timed once
TOLERANCES = (0.5, 0.2, 0.1, 0.05, 0.02, 0.01, 1e-3)
KNOBS = ("stiffness", "alpha", "contact_overlap", "passes", "tolerance", "overlap", "contacts")


@dataclass(frozen=True)
class ContactSetting:
    """One setting of the contact solve; `series` is the knob that it changes."""

    series: str
    mechanics: tf.Mechanics
    dt: float = DT
    dtype: torch.dtype = torch.float32
    default: bool = False
    preset: str = ""

    @classmethod
    def of_preset(cls, name: str, scene: tf.Scene) -> ContactSetting:
        """Returns the mechanics of `tf.preset(name, scene)`."""
        tuned = tf.preset(name, scene).apply(scene)
        return cls("preset", mechanics_of(tuned), tuned.dt, preset=name)

    @property
    def label(self) -> str:
        """The setting as a user would give it: only the values that differ from the default."""
        plain = tf.Mechanics(dim=self.mechanics.dim)
        changed = [
            f"{n}={f'{value:g}' if isinstance(value, int | float) else repr(value)}"
            for n in KNOBS
            if (value := getattr(self.mechanics, n)) != getattr(plain, n)
        ]
        knobs = ", ".join(
            [f"dt={self.dt:g}", *changed, *(["float64"] if self.dtype == torch.float64 else [])]
        )
        return f"preset {self.preset}: {knobs}" if self.preset else knobs

    def scene(self, like: tf.Scene) -> tf.Scene:
        """Returns the scene `like` with these mechanics and this step."""
        effects = (self.mechanics if isinstance(e, tf.Mechanics) else e for e in like.effects)
        return like.replace(*effects, dt=self.dt)

    def start(self, state: tf.State) -> tf.State:
        """Returns the state in this precision."""
        cast = lambda x: x.to(self.dtype) if x.is_floating_point() else x
        fields = {name: cast(value) for name, value in state.fields.items()}
        return state.replace(
            axis=cast(state.axis),
            length=cast(state.length),
            radius=cast(state.radius),
            fields=fields,
        )

    def rows(self, counter: RowCounter) -> float:
        """Returns the number of contact rows that products read.

        A row of a wall has half the entries of a row between two cells and counts half.
        """
        return counter.bytes / (
            2 * self.mechanics.settings.degrees * torch.finfo(self.dtype).bits // 8
        )


def with_passes(mechanics: tf.Mechanics, passes: int) -> tf.Mechanics:
    """Returns mechanics with this many passes at most; those of bilateral contacts solve to the
    overlap of `tf.Settings(passes=…)`: 0.02 µm, less where α·γ is below 0.1."""
    if mechanics.one_sided:
        return dataclasses.replace(mechanics, passes=passes)
    return mechanics.with_settings(tf.Settings(passes=passes))


def mechanics_of(scene: tf.Scene) -> tf.Mechanics:
    """Returns the contact mechanics of a scene."""
    return next(e for e in scene.effects if isinstance(e, tf.Mechanics))


def followed(
    choice: ContactSetting, like: tf.Scene, first: tf.State, hours: float
) -> tuple[tf.State, float, float]:
    """Returns the state `hours` later, the seconds (a median if short) and the rows read."""
    start = choice.start(first)

    def run(scene: tf.Scene) -> tf.State:
        state = tf.simulate(scene, start, until=start.time + hours).last()
        return state

    return timed_and_counted(choice, like, run)


def timed_and_counted(
    choice: ContactSetting, like: tf.Scene, run: Callable[[tf.Scene], Any]
) -> tuple[Any, float, float]:
    """Returns the result of `run` for the scene, the seconds (a median if short) and the rows read.

    Kernels count no rows. Where they are used, rows are counted in a run by torch, which takes the
    same steps.
    """
    by_torch = dataclasses.replace(choice.mechanics, backend="torch")
    kernels = choice.mechanics.backend_on(torch.device("cpu")) == "compiled"
    counted = dataclasses.replace(choice, mechanics=by_torch) if kernels else choice
    with RowCounter() as counter:
        found, seconds = timed(lambda: run(counted.scene(like)), 1)
    if kernels or seconds < SHORT:
        found, seconds = timed(lambda: run(choice.scene(like)))
    return found, seconds, choice.rows(counter)
