"""What a CellModeller script finds in place of CellModeller: classes that record what it asks for.

`Request` is that record. `modules()` gives the stand-in modules, which are in `sys.modules` only
while a script is loaded and set up. Nothing here simulates.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from types import ModuleType
from typing import Any

from torchfilm.tools.checks import InputError

DT = 0.05  # h, CellModeller's step
LENGTH, RADIUS = 3.5, 0.5  # µm, of a cell that addCell adds
# Options of CLBacterium that set the size of its memory, its speed or its messages.
SIZES = (
    "max_substeps", "max_cells", "max_contacts", "max_planes", "max_spheres", "max_sqs",
    "grid_spacing", "cgs_tol", "reg_param", "printing", "compNeighbours",
)  # fmt: skip


@dataclass
class Request:
    """What a script has asked for in `setup(sim)`.

    options: of CLBacterium. planes: (point, normal, coefficient) each; spheres: (centre, radius,
    coefficient, sign). cells: keywords of each addCell. grid, integrator: options, or None.
    ignored: what the script gave that CellModeller does not use either, in words.
    """

    options: dict[str, Any] | None = None
    planes: list[tuple[Any, Any, float]] = field(default_factory=list)
    spheres: list[tuple[Any, float, float, float]] = field(default_factory=list)
    cells: list[dict[str, Any]] = field(default_factory=list)
    grid: dict[str, Any] | None = None
    integrator: dict[str, Any] | None = None
    started: bool = False  # sim.init was called
    ignored: list[str] = field(default_factory=list)


class _Recorder:
    """Base of the stand-ins: a name that they lack is refused."""

    _title = ""

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        raise InputError(
            f"{self._title}.{name} is not supported by torchfilm: it is a part of CellModeller's"
            " own machinery."
        )


class Simulator(_Recorder):
    """`sim`, as `setup(sim)` gets it. Scripts may keep it, and read `stepNum` and `cellStates`."""

    _title = "sim"
    # what may be set; the first group also after setup(sim), where it changes nothing
    _idle = (
        "pickleSteps", "saveOutput", "outputDirName", "outputDirPath", "renderers", "is_gui",
    )  # fmt: skip
    _settable = (
        *_idle, "dt", "moduleName", "moduleStr", "module", "phys", "reg", "sig", "integ",
    )  # fmt: skip

    def __init__(self, request: Request, module: ModuleType):
        self._request, self._running, self._step = request, False, 0
        self._cells: dict[int, Any] | None = {}
        self.module, self.moduleName, self.moduleStr = module, module.__name__, None
        self.dt, self.is_gui = DT, False
        self.pickleSteps, self.saveOutput = 50, False
        self.outputDirName = self.outputDirPath = None
        self.renderers: list[Any] = []
        self.phys = self.reg = self.sig = self.integ = None

    def __setattr__(self, name: str, value: Any) -> None:
        if name not in self._settable and not name.startswith("_"):
            raise InputError(f"sim.{name} = … is not supported by torchfilm.")
        if name in self._settable and name not in self._idle and self.__dict__.get("_running"):
            raise InputError(f"sim.{name} = … after setup(sim) is not supported by torchfilm.")
        self.__dict__[name] = value

    @property
    def stepNum(self) -> int:
        """Steps that are over."""
        return self._step

    @property
    def cellStates(self) -> dict[int, Any]:
        """In `update(cells)`, these cells."""
        if self._cells is None:
            raise InputError("sim.cellStates is known in update(cells) only.")
        return self._cells

    def _at(self, step: int, cells: dict[int, Any] | None = None) -> None:
        """What scripts read from now on; they can set up no more."""
        self._running, self._step, self._cells = True, step, cells

    def init(self, phys: Any, reg: Any, sig: Any = None, integ: Any = None) -> None:
        for given, kind, name in (
            (phys, CLBacterium, "the biophysics"),
            (reg, ModuleRegulator, "the regulation"),
            (sig, GridDiffusion, "the signalling"),
            (integ, _Integrator, "the integrator"),
        ):
            wanted = kind.__name__ if kind is not _Integrator else "one of CellModeller's"
            if not isinstance(given, kind) and not (given is None and name[-2:] in ("ng", "or")):
                raise InputError(
                    f"sim.init: {name} is {type(given).__name__}: it must be {wanted}."
                )
        if (sig is None) != (not isinstance(integ, _SignalIntegrator)):
            raise InputError(
                "sim.init: GridDiffusion needs CLCrankNicIntegrator or CLEulerSigIntegrator, and"
                " these need GridDiffusion."
            )
        self.phys, self.reg, self.sig, self.integ = phys, reg, sig, integ
        self._request.options = phys.options
        self._request.grid = None if sig is None else sig.options
        self._request.integrator = None if integ is None else integ.options
        self._request.started = True

    def addCell(
        self, cellType: int = 0, cellAdh: int = 0, length: float = LENGTH, **given: Any
    ) -> None:
        if not self._request.started:
            raise InputError("sim.addCell before sim.init: CellModeller has no models to add to.")
        if self._running:
            raise InputError("sim.addCell after setup(sim) is not supported by torchfilm.")
        cell: dict[str, Any] = {n: given.pop(n) for n in ("pos", "dir", "rad") if n in given}
        self._request.cells.append({"cellType": cellType, "length": length, **cell})
        self._request.ignored += [
            f"addCell({name}=…): CellModeller ignores this option"
            for name in (*(["cellAdh"] if cellAdh else []), *given)
        ]

    def addRenderer(self, renderer: Any) -> None:
        """Pictures are drawn by torchfilm."""

    def setSaveOutput(self, save: bool) -> None:
        """Results are written by torchfilm."""

    def _pickle(self, *given: Any, **options: Any) -> None:
        raise InputError(
            "sim.loadFromPickle is not supported: a pickle can execute code, and torchfilm reads"
            " data only. Give the first cells as a table: torchfilm run SCRIPT --start cells.csv."
        )

    loadFromPickle = loadGeometryFromPickle = setCellStates = _pickle


class CLBacterium(_Recorder):
    """The biophysics: its options, planes and spheres."""

    _title = "CLBacterium"
    _known = ("muA", "gamma", "dt", "jitter_z", "alternate_divisions", *SIZES)

    def __init__(self, simulator: Simulator, *sizes: Any, **options: Any):
        options = {**dict(zip(_POSITIONAL, sizes, strict=False)), **options}
        if len(sizes) > len(_POSITIONAL):
            raise InputError("CLBacterium got too many values: name its options.")
        for name in options:
            if name not in self._known:
                raise InputError(
                    f"CLBacterium({name}=…) is not supported; known are {', '.join(self._known)}."
                )
        if options.get("alternate_divisions"):
            raise InputError(
                "CLBacterium(alternate_divisions=True) is not supported: daughters lie end to end"
                " here."
            )
        self.options, self._request = options, simulator._request

    def addPlane(self, pt: Any, norm: Any, coeff: float) -> None:
        self._request.planes.append((pt, norm, coeff))

    def addSphere(self, pt: Any, rad: float, coeff: float, norm: float) -> None:
        self._request.spheres.append((pt, rad, coeff, norm))


_POSITIONAL = ("max_substeps", "max_cells", "max_contacts", "max_planes", "max_spheres", "max_sqs",
               "grid_spacing", "muA", "gamma", "dt", "cgs_tol", "jitter_z")  # fmt: skip


class ModuleRegulator(_Recorder):
    """The regulation: the script's own functions, which torchfilm calls."""

    _title = "ModuleRegulator"

    def __init__(self, sim: Simulator, *given: Any, **options: Any):
        pass


class GridDiffusion(_Recorder):
    """The grid of signals."""

    _title = "GridDiffusion"

    def __init__(
        self, sim: Simulator, nSignals: int, gridDim: Any, gridSize: Any, gridOrig: Any, D: Any,
        adv: Any = None, initLevels: Any = None, regul: Any = None,
    ):  # fmt: skip
        if adv is not None and any(adv):
            raise InputError(
                "GridDiffusion(adv=…) is not supported: write a scene with tf.Medium(flow=…)."
            )
        self.options = {
            "signals": nSignals, "dim": tuple(gridDim), "size": tuple(gridSize),
            "origin": tuple(gridOrig), "diffusion": list(D), "initial": initLevels,
        }  # fmt: skip


class _Integrator(_Recorder):
    options: dict[str, Any]


class CLEulerIntegrator(_Integrator):
    """Species only."""

    _title = "CLEulerIntegrator"

    def __init__(self, sim: Simulator, nSpecies: int, maxCells: int, regul: Any = None):
        self.options = {"species": nSpecies, "kind": self._title}


class _SignalIntegrator(_Integrator):
    def __init__(
        self, nSignals: int, nSpecies: int, sig: Any, boundcond: str
    ):  # fmt: skip
        if not isinstance(sig, GridDiffusion):
            raise InputError(f"{self._title}: the signalling must be GridDiffusion.")
        if nSignals != sig.options["signals"]:
            raise InputError(
                f"{self._title} has {nSignals} signals and GridDiffusion {sig.options['signals']}:"
                " give both the same number."
            )
        self.options = {"species": nSpecies, "kind": self._title, "boundary": boundcond}


class CLCrankNicIntegrator(_SignalIntegrator):
    """Species and signals."""

    _title = "CLCrankNicIntegrator"

    def __init__(
        self, sim: Simulator, nSignals: int, nSpecies: int, maxCells: int, sig: Any,
        greensThreshold: float = 1e-12, regul: Any = None, boundcond: str = "constant",
    ):  # fmt: skip
        super().__init__(nSignals, nSpecies, sig, boundcond)


class CLEulerSigIntegrator(_SignalIntegrator):
    """Species and signals."""

    _title = "CLEulerSigIntegrator"

    def __init__(
        self, sim: Simulator, nSignals: int, nSpecies: int, maxCells: int, sig: Any,
        regul: Any = None, boundcond: str = "constant",
    ):  # fmt: skip
        super().__init__(nSignals, nSpecies, sig, boundcond)


class _Renderer:
    """Draws nothing."""

    def __init__(self, *given: Any, **options: Any):
        pass


class _Renderers(ModuleType):
    """A module in which every renderer can be named."""

    def __getattr__(self, name: str) -> Any:
        if not name.startswith("GL"):
            raise AttributeError(name)
        return _Renderer


ROOT = "CellModeller"
CLASSES: dict[str, tuple[Any, ...]] = {
    "Simulator": (Simulator,),
    "Regulation.ModuleRegulator": (ModuleRegulator,),
    "Biophysics.BacterialModels.CLBacterium": (CLBacterium,),
    "Signalling.GridDiffusion": (GridDiffusion,),
    "Integration.CLEulerIntegrator": (CLEulerIntegrator,),
    "Integration.CLCrankNicIntegrator": (CLCrankNicIntegrator,),
    "Integration.CLEulerSigIntegrator": (CLEulerSigIntegrator,),
    "GUI.Renderers": (),
}


def modules() -> dict[str, ModuleType]:
    """The stand-in modules by full name."""
    made: dict[str, ModuleType] = {}
    for path, classes in CLASSES.items():
        parts = [ROOT, *path.split(".")]
        for k in range(1, len(parts) + 1):
            name = ".".join(parts[:k])
            if name in made:
                continue
            kind = _Renderers if name.endswith("Renderers") else ModuleType
            made[name] = kind(name)
            made[name].__path__ = []  # a package, without files
            if k > 1:
                setattr(made[".".join(parts[: k - 1])], parts[k - 1], made[name])
        for given in classes:
            setattr(made[".".join(parts)], given.__name__, given)
    return made


@contextmanager
def installed() -> Iterator[None]:
    """Within, imports of CellModeller find the stand-ins; afterwards what was there before."""
    ours = lambda name: name == ROOT or name.startswith(ROOT + ".")
    before = {name: module for name, module in sys.modules.items() if ours(name)}
    for name in before:
        del sys.modules[name]
    sys.modules.update(modules())
    try:
        yield
    finally:
        for name in [n for n in sys.modules if ours(n)]:
            del sys.modules[name]
        sys.modules.update(before)
