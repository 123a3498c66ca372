"""Scripts in the style of CellModeller 4, for the tests."""

from __future__ import annotations

from pathlib import Path

HEAD = """
import math
import random
import numpy
from CellModeller.Biophysics.BacterialModels.CLBacterium import CLBacterium
from CellModeller.GUI import Renderers
from CellModeller.Integration.CLCrankNicIntegrator import CLCrankNicIntegrator
from CellModeller.Integration.CLEulerIntegrator import CLEulerIntegrator
from CellModeller.Integration.CLEulerSigIntegrator import CLEulerSigIntegrator
from CellModeller.Regulation.ModuleRegulator import ModuleRegulator
from CellModeller.Signalling.GridDiffusion import GridDiffusion
"""

SETUP = """
def setup(sim):
    body = CLBacterium(sim, jitter_z=False, gamma=50)
    sim.init(body, ModuleRegulator(sim, sim.moduleName), None, None)
    sim.addCell(cellType=0, pos=(-4, 0, 0))
    sim.addCell(cellType=1, pos=(4, 0, 0), dir=(0, 1, 0), length=2.5)
    sim.addRenderer(Renderers.GLBacteriumRenderer(sim))
"""

INIT = """
def init(cell):
    cell.targetVol = 3 + random.uniform(0.0, 0.5)
    cell.growthRate = 1.0
    cell.plasmids = 6
"""

UPDATE = """
def update(cells):
    fastest = 1.2
    for (id, cell) in cells.items():
        cell.color = [cell.cellType * 0.5, cell.plasmids / 12.0, 0.2]
        if cell.cellType == 1:
            cell.growthRate = fastest / max(1.0, cell.length - 2)
        if cell.volume > cell.targetVol:
            cell.divideFlag = True
"""

DIVIDE = """
def divide(parent, d1, d2):
    copies = [0] * parent.plasmids + [1] * parent.plasmids
    random.shuffle(copies)
    d1.plasmids = sum(copies)
    d2.plasmids = 2 * parent.plasmids - d1.plasmids
    for d in (d1, d2):
        d.targetVol = 3 + numpy.random.uniform(0.0, 0.5)
"""

GROWS = HEAD + SETUP + INIT + UPDATE + DIVIDE

CHEMISTRY = """
grid = dict(gridDim=(12, 12, 4), gridSize=(4, 4, 4), gridOrig=(-22, -22, -6))

def setup(sim):
    body = CLBacterium(sim, jitter_z=False)
    sig = GridDiffusion(sim, 1, D=[6.0], **grid)
    integ = {integrator}(sim, 1, 2, 1000, sig, boundcond='reflect')
    sim.init(body, ModuleRegulator(sim), sig, integ)
    sim.addCell(pos=(0, 0, 0), length=3.0)

def init(cell):
    cell.growthRate = {rate}
    cell.species[:] = [4.0, 0]
    cell.signals[:] = [0]

def specRateCL():
    return '''
    const float k = %g; // made in the cell
    rates[0] = 0;
    rates[1] = k;
    ''' % 2.0

def sigRateCL():
    return '''rates[0] = 0.5f*species[0];'''

def update(cells):
    for (id, cell) in cells.items():
        cell.seen = cell.signals[0]
"""

signalling = lambda integrator="CLEulerSigIntegrator", rate=0.0: (
    HEAD + CHEMISTRY.format(integrator=integrator, rate=rate)
)


def written(folder: Path, text: str, name: str = "model.py") -> Path:
    path = folder / name
    path.write_text(text)
    return path
