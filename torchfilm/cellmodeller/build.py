"""Builds a scene from what a script has asked for."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np

from torchfilm.cellmodeller import draws
from torchfilm.cellmodeller.columns import ColumnRule, Uneven
from torchfilm.cellmodeller.loading import SECONDS, Script, importing, load
from torchfilm.cellmodeller.rates import SIGNAL, SPECIES, TextRates
from torchfilm.cellmodeller.rehearsal import rehearse
from torchfilm.cellmodeller.script_rules import ScriptRules
from torchfilm.cellmodeller.sheets import CellLayout
from torchfilm.cellmodeller.stand_ins import LENGTH, RADIUS
from torchfilm.effect import Effect
from torchfilm.effects.circuit import Circuit
from torchfilm.effects.division import Division
from torchfilm.effects.growth import Growth
from torchfilm.effects.mechanics import Mechanics
from torchfilm.effects.medium import Medium
from torchfilm.effects.signal import Signal
from torchfilm.initial_cells import Cells
from torchfilm.physics.walls import Plane, Sphere, Wall
from torchfilm.scene import Scene
from torchfilm.signals.boundary_conditions import BoundaryConditions, Dirichlet, NoFlux, Periodic
from torchfilm.state import State
from torchfilm.tools import checks
from torchfilm.tools.checks import InputError
from torchfilm.tools.hashing import digest
from torchfilm.tools.warn_once import warn

LOOPS = ("auto", "columns", "cells")
GAMMA = 10.0  # CLBacterium's
# CellModeller draws each component of a daughter's axis from ±0.001
AXIS_NOISE = 0.001 / math.sqrt(3.0)
# transportRates divides the diffusion constant by 6 as well as by h²; the Crank–Nicolson integrator
# halves it again, and does not store what its implicit half gives
SPREAD = {"CLEulerSigIntegrator": 1 / 6, "CLCrankNicIntegrator": 1 / 12}
BOUNDARIES = ("constant", "reflect", "nearest", "wrap")


@checks.known_keywords
def from_cellmodeller(
    path: str | Path,
    *,
    loop: str = "auto",
    contacts: str = "one-sided",
    method: str = "rosenbrock",
    seconds: float = SECONDS,
) -> Scene:
    """The scene of a CellModeller 4 script, which runs as Python: its file, `setup(sim)`, and in
    each step `update(cells)` and `divide(parent, d1, d2)`.

    loop: "columns", `update` acts on all cells at once; "cells", one cell after the other, which is
    slow; "auto", columns where the loop is plain. contacts: as for `Mechanics`. method: of
    `Circuit`. seconds: that the script may take to be loaded, and each function in a rehearsal
    before the run; then it is stopped, with the line where it was. Raises InputError, with the line
    of the script, for what is not supported.
    """
    checks.choice("loop", loop, LOOPS)
    path = Path(path)
    if not path.is_file():
        raise checks.input_error("script", str(path), "the path of a Python file", "No such file.")
    try:
        limit = checks.number("seconds", seconds, above=0.0)
        return _scene(load(path, limit), loop, contacts, method)
    except InputError as error:
        if str(error).startswith(path.name):
            raise
        raise InputError(f"{path.name}: {error}") from error


def _scene(script: Script, loop: str, contacts: str, method: str) -> Scene:
    for words in script.request.ignored:
        warn(f"{script.path.name}: {words}, and so does torchfilm.")
    dim = 2 if _is_flat(script) else 3
    founders = _founders(script, dim)
    options = script.request.options or {}
    given = {
        name: checks.number(f"CLBacterium({name}=…)", options.get(name, usual), above=0.0)
        for name, usual in (("gamma", GAMMA), ("muA", 1.0))
    }
    effects: list[Effect] = [
        script_rules(script, loop, founders),
        Growth(law="length"),
        Division(axis_noise=AXIS_NOISE),
        Mechanics(
            dim=dim,
            walls=_walls(script, dim),
            length_drag=given["gamma"],
            viscosity=given["muA"],
            contacts=contacts,
        ),
        *_chemistry(script, method),
    ]
    return Scene(*effects, name=script.path.stem, dt=script.dt, founders=founders)


def script_rules(script: Script, loop: str, founders: Cells | None = None) -> ScriptRules:
    """The effect of a script, after a rehearsal of its functions."""
    founders = founders or _founders(script, 2 if _is_flat(script) else 3)
    integrator, grid = script.request.integrator, script.request.grid
    options = script.request.options or {}
    species = checks.integer("nSpecies", integrator["species"], least=1) if integrator else 0
    signals = checks.integer("nSignals", grid["signals"], least=1) if grid else 0
    bare = CellLayout({}, species, signals, bool(options.get("compNeighbours")))
    layout, first = rehearse(script, bare, founders)
    rule, reason = None, "--set loop=cells"
    if loop != "cells":
        try:
            rule = _column_rule(script, layout, first)
        except Uneven as error:
            reason = str(error)
            if loop == "columns":
                raise InputError(
                    f"{script.path.name}: update(cells) cannot act on whole columns: {reason}."
                ) from error
    if rule is None:
        warn(
            f"{script.path.name}: update(cells) runs cell by cell, which is slow ({reason})."
            " A loop is fast where it only calculates with the cell's own numbers."
        )
    used = "cells" if rule is None else "columns"
    return ScriptRules(script.path.name, digest(script.text), used, reason, script, layout, rule)


def _column_rule(script: Script, layout: CellLayout, first: State) -> ColumnRule:
    """The rule on whole columns, tried on first cells. Raises Uneven if there is none."""
    rule = ColumnRule(script.text, script.module, layout)
    if script.mentions("deathFlag"):
        raise Uneven("it uses deathFlag")
    rule.act(first)
    return rule


# --- geometry -----------------------------------------------------------------------------


def _vector(name: str, value: Any) -> tuple[float, float, float]:
    found = checks.vector(name, value, 3)
    return (float(found[0]), float(found[1]), float(found[2]))


def _normal(value: Any) -> tuple[float, float, float]:
    found = _vector("addPlane: normal", value)
    if not any(found):
        raise checks.input_error("addPlane: normal", value, "a direction that is not zero")
    return found


def _size(cell: dict[str, Any], name: str, usual: float) -> float:
    return checks.number(f"addCell({name}=…)", cell.get(name, usual), least=0.0)


def _is_flat(script: Script) -> bool:
    """Whether no cell can leave the plane z = 0: CLBacterium(jitter_z=False), first cells in it,
    and no wall that presses them out of it."""
    request = script.request
    if (request.options or {}).get("jitter_z", True):
        return False
    for cell in request.cells:
        for name, default in (("pos", (0, 0, 0)), ("dir", (1, 0, 0))):
            if _vector(f"addCell({name}=…)", cell.get(name, default))[2] != 0:
                return False
    radius = max([_size(c, "rad", RADIUS) for c in request.cells], default=RADIUS)
    for point, normal, _ in request.planes:
        p, n = _vector("addPlane: point", point), _normal(normal)
        if n[2] != 0 and ((n[0], n[1]) != (0, 0) or -p[2] * n[2] < radius * abs(n[2]) - 1e-6):
            return False
    return all(_vector("addSphere: centre", s[0])[2] == 0 for s in request.spheres)


def _founders(script: Script, dim: int) -> Cells:
    cells = script.request.cells
    if not cells:
        raise InputError(f"{script.path.name}: setup(sim) adds no cell (sim.addCell).")
    pos = [_vector("addCell(pos=…)", c.get("pos", (0, 0, 0))) for c in cells]
    axis = [_vector("addCell(dir=…)", c.get("dir", (1, 0, 0))) for c in cells]
    return Cells(
        np.array(pos)[:, :dim],
        np.array(axis)[:, :dim],
        [_size(c, "length", LENGTH) for c in cells],
        [_size(c, "rad", RADIUS) for c in cells],
        cell_type=[c["cellType"] for c in cells],
    )


def _walls(script: Script, dim: int) -> list[Wall]:
    walls: list[Wall] = []
    for point, normal, coefficient in script.request.planes:
        p, n = _vector("addPlane: point", point), _normal(normal)
        if dim == 2 and (n[0], n[1]) == (0, 0):
            continue  # it touches no cell in the plane
        weight = checks.number("addPlane: coefficient", coefficient, above=0.0)
        walls.append(Plane(point=p[:dim], normal=n[:dim], weight=weight))
    for centre, radius, coefficient, sign in script.request.spheres:
        checks.choice("addSphere: norm", sign, (-1, 1))
        walls.append(
            Sphere(
                _vector("addSphere: centre", centre)[:dim],
                radius,
                inside=sign < 0,
                weight=checks.number("addSphere: coefficient", coefficient, above=0.0),
            )
        )
    return walls


# --- species and signals ------------------------------------------------------------------


def _chemistry(script: Script, method: str) -> list[Effect]:
    integrator, grid = script.request.integrator, script.request.grid
    if integrator is None:
        return []
    kind = integrator["kind"]
    species_text = _text_of(script, "specRateCL", kind)
    signals_text = None if grid is None else _text_of(script, "sigRateCL", kind)
    volume = (
        None if grid is None else float(math.prod(_vector("GridDiffusion: size", grid["size"])))
    )
    count = integrator["species"]
    rates = TextRates(
        species_text,
        signals_text,
        count,
        grid["signals"] if grid else 0,
        volume,
        script.path.name,
        script.text,
    )
    circuit = Circuit(rates, species=[SPECIES.format(k) for k in range(count)], method=method)
    return [circuit] if grid is None else [circuit, _medium(integrator, grid)]


def _text_of(script: Script, name: str, kind: str) -> str:
    """The OpenCL text that a function of a script returns. kind: the integrator, which needs it."""
    function = script.function(name)
    if function is None:
        raise InputError(f"{script.path.name}: {kind} needs the function {name}().")
    with draws.kept(), importing(script), script.errors(f"{name}()"), script.limited():
        text = function()
    if not isinstance(text, str):
        raise InputError(
            f"{script.path.name}: {name}() returned {type(text).__name__}: it must return OpenCL"
            " text."
        )
    return text


def _medium(integrator: dict[str, Any], grid: dict[str, Any]) -> Medium:
    """The grid of CellModeller: values at its nodes are here the centres of voxels."""
    checks.choice("boundcond", integrator["boundary"], BOUNDARIES)
    count = grid["signals"]
    origin, size, voxels = (
        np.array(_vector(f"GridDiffusion: {name}", grid[name]))
        for name in ("origin", "size", "dim")
    )
    low = origin - size / 2
    high = low + voxels * size
    first = [0.0] * count if grid["initial"] is None else list(grid["initial"])
    for name, values in (("D", grid["diffusion"]), ("initLevels", first)):
        if len(values) != count:
            raise InputError(
                f"GridDiffusion has {count} signals and {len(values)} values of {name}."
            )
    faces: dict[str, Any] = {"wrap": Periodic(), "reflect": NoFlux(), "nearest": NoFlux()}
    signals: dict[str, Any] = {}
    for k in range(count):
        face = faces.get(integrator["boundary"], Dirichlet(float(first[k])))
        signals[SIGNAL.format(k)] = Signal(
            diffusion=float(grid["diffusion"][k]) * SPREAD[integrator["kind"]],
            initial=float(first[k]),
            boundary=BoundaryConditions(x=face, y=face, z=face),
        )
    return Medium(
        **signals,
        box=(tuple(low.tolist()), tuple(high.tolist())),
        spacing=tuple(size.tolist()),
        outside="reservoir",
    )
