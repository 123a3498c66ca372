"""Signalling through the medium: Lux quorum sensing, detection of a boundary, lysis in step.

The first two follow the paper's Table 2 and Fig. 5.
"""

from __future__ import annotations

from torch import Tensor

from torchfilm.circuits.names import Names
from torchfilm.distributions import Uniform
from torchfilm.effects.circuit import Circuit
from torchfilm.effects.division import Division
from torchfilm.effects.growth import Growth
from torchfilm.effects.lysis import Lysis
from torchfilm.effects.mechanics import Mechanics
from torchfilm.effects.medium import Medium
from torchfilm.effects.signal import Signal
from torchfilm.initial_cells import Cells
from torchfilm.physics.walls import Channel
from torchfilm.scene import Scene

Value = float | Tensor


def _lux(u: Names, s: Names, p: Names, cell: Names):
    into = p.D1 * (s.ahl - u.ahl) * cell.area
    return {
        "luxi": p.d2 + p.k3 * u.ahl**2 / (p.k4 + u.ahl**2) - p.g1 * u.luxi,
        "ahl": p.k1 * u.luxi / (p.k2 + u.luxi) + into / cell.volume,
    }, {"ahl": -into}


def quorum_sensing(
    D1: Value = 100.0,
    d2: Value = 1e-3,
    k1: Value = 100.0,
    k2: Value = 1.0,
    k3: Value = 1.0,
    k4: Value = 1e-4,
    g1: Value = 0.1,
    diffusion: Value = 1000.0,
    rate: float = 1.0,
    size: float = 128.0,
    spacing: float = 4.0,
    length_drag: float = 10.0,
) -> Scene:
    """Lux quorum sensing (Table 2): together the cells make enough AHL to switch LuxI on.

    AHL crosses the cells' membranes and diffuses (`diffusion`, µm²/h). D1: µm/h, membrane. k1, k2:
    AHL from LuxI. d2, k3, k4: LuxI, basal and induced. g1: its decay, 1/h. rate: of growth, 1/h.
    The box, `size` µm wide, in voxels of `spacing` µm, has no-flux faces. With the constants that
    Table 2 prints (D1 = k1 = k4 = 1; d2 without a value, its d1 is 1e-3) dilution of LuxI is faster
    than its induction, and nothing switches. With the constants here it switches, the sooner the
    smaller the box.

    Pressure limits growth (length_drag 10, the paper's): the constants are for its dilution.
    """
    half = size / 2
    return Scene(
        Growth(rate=rate),
        Division(length=Uniform(3.5, 4.5)),
        Mechanics(dim=2, length_drag=length_drag),
        Circuit(_lux, species=("luxi", "ahl"), D1=D1, d2=d2, k1=k1, k2=k2, k3=k3, k4=k4, g1=g1),
        Medium(
            ahl=Signal(diffusion=diffusion), box=((-half, -half), (half, half)), spacing=spacing
        ),
    )


def _sources(u: Names, s: Names, p: Names, cell: Names):
    into = p.D1 * (s.ahl - u.ahl) * cell.area
    return {
        "luxi": p.d1 - p.g1 * u.luxi,
        "ahl": p.k1 * u.luxi / (p.k2 + u.luxi) + into / cell.volume,
        "cfp": p.d2 + p.k3 * u.ahl**2 / (p.k4 + u.ahl**2) - p.dr * u.cfp,
    }, {"ahl": -into}


def _sinks(u: Names, s: Names, p: Names, cell: Names):
    into = p.D1 * (s.ahl - u.ahl) * cell.area
    return {
        "aiia": p.d3 - p.g2 * u.aiia,
        "ahl": -p.k5 * u.aiia * u.ahl / (p.k6 + u.ahl) + into / cell.volume,
        "yfp": p.d2 + p.k3 * u.ahl**2 / (p.k4 + u.ahl**2) - p.dr * u.yfp,
    }, {"ahl": -into}


def boundary_detector(
    D1: Value = 0.1,
    d1: Value = 1e-3,
    d2: Value = 1e-5,
    d3: Value = 1e-3,
    dr: Value = 0.1,
    g1: Value = 0.1,
    g2: Value = 0.1,
    k1: Value = 1.0,
    k2: Value = 1.0,
    k3: Value = 1.0,
    k4: Value = 5e-5,
    k5: Value = 0.1,
    k6: Value = 1e-2,
    diffusion: Value = 10.0,
    flow: Value = 0.0,
    rate: float = 1.0,
    width: float = 32.0,
    rtol: float = 1e-4,
    length_drag: float = 10.0,
    spacing: float = 4.0,
) -> Scene:
    """Detection of the boundary between two populations (Fig. 5), in one plane of a channel.

    Each population starts from one founder; the channel is `width` µm wide. Sources (type 0, on the
    left) make AHL by LuxI and report it by CFP. Sinks (type 1) degrade AHL by AiiA and report it by
    YFP: only those at the boundary detect it. Constants are as published (hours, µm, arbitrary
    concentration): D1, through the membrane; d1, g1, of LuxI; k1, k2, of AHL by LuxI; d3, g2, of
    AiiA (d3 = 0 is a strain without it); k5, k6, of AHL by AiiA; d2, k3, k4, dr, of both reporters,
    basal, induced and lost; diffusion, µm²/h; rate, of growth, 1/h. flow: µm/h along the channel.
    rtol: relative tolerance of the circuits in a step. The grid, with voxels of `spacing` = 4 µm,
    starts as the paper's 64 × 8 × 12 voxels around the cells' plane and grows along the channel
    with the colony.

    Pressure limits growth (length_drag 10, the paper's). With free growth (1e5) the published
    constants give no band: reporters are diluted faster than they are made.
    """
    half = width / 2
    circuit = Circuit(
        {0: _sources, 1: _sinks}, species=("luxi", "ahl", "aiia", "cfp", "yfp"), rtol=rtol,
        D1=D1, d1=d1, d2=d2, d3=d3, dr=dr, g1=g1, g2=g2, k1=k1, k2=k2, k3=k3, k4=k4, k5=k5, k6=k6,
    )  # fmt: skip
    return Scene(
        Growth(rate=rate),
        Division(length=Uniform(3.5, 4.5)),
        Mechanics(dim=2, walls=[Channel(width)], length_drag=length_drag),
        circuit,
        Medium(
            # its AHL is slow, and searches run it thousands of times
            exchange="turns",
            ahl=Signal(diffusion=diffusion),
            box=((-128.0, -half, -24.0), (128.0, half, 24.0)),
            spacing=spacing,
            outside="grow",
            grows="x",
            flow=None if isinstance(flow, (int, float)) and flow == 0 else (flow, 0.0, 0.0),
        ),
        founders=Cells([[-1.5, 0.0], [1.5, 0.0]], [[1.0, 0.0], [1.0, 0.0]], cell_type=[0, 1]),
        type_names=("source", "sink"),
    )


def _lytic(u: Names, s: Names, p: Names, cell: Names):
    on = s.ahl**2 / (p.half**2 + s.ahl**2)
    made = {
        "lysis_protein": p.strength * on - p.loss * u.lysis_protein,
        "cargo": p.cargo + 0.0 * u.cargo,
    }
    return made, {"ahl": p.make * (p.leak + on) * cell.volume}


def synchronized_lysis(
    half: Value = 0.1,
    make: Value = 100.0,
    leak: Value = 0.05,
    strength: Value = 20.0,
    loss: Value = 2.0,
    cargo: Value = 1.0,
    threshold: Value = 4.0,
    lysis_rate: Value = 3.0,
    decay: Value = 8.0,
    diffusion: Value = 1e6,
    rate: float = 1.2,
    size: float = 120.0,
    spacing: float = 20.0,
    length_drag: float = 1e5,
) -> Scene:
    """A population that grows, bursts together, releases its cargo, and grows again.

    The plan is that of Din et al. 2016 (Nature 536, 81); equations and constants are chosen here,
    for colonies of some hundred cells. AHL activates both its own synthesis and a lysis protein
    beyond `half`; make: of AHL, conc/h, `leak` of it without AHL. strength, loss: of the lysis
    protein, conc/h and 1/h. Above `threshold` cells burst, `lysis_rate` per hour, and release their
    cargo (made at `cargo` conc/h). Both diffuse (`diffusion`, µm²/h). What flow would carry away
    decays, `decay` per hour, in a box `size` µm wide and 1 µm deep, in voxels of `spacing` µm, with
    no-flux faces. Growth, at `rate`, 1/h, is free (length_drag 1e5).
    """
    corner = size / 2
    return Scene(
        Growth(rate=rate),
        Division(length=Uniform(3.5, 4.5)),
        Mechanics(dim=2, length_drag=length_drag),
        Circuit(
            _lytic,
            species=("lysis_protein", "cargo"),
            half=half,
            make=make,
            leak=leak,
            strength=strength,
            loss=loss,
            cargo=cargo,
        ),
        Lysis("lysis_protein", above=threshold, rate=lysis_rate, releases={"cargo": "cargo"}),
        Medium(
            ahl=Signal(diffusion=diffusion, decay=decay),
            cargo=Signal(diffusion=diffusion, decay=decay),
            box=((-corner, -corner), (corner, corner)),
            spacing=spacing,
            depth=1.0,
        ),
    )
