"""Kernels' parts of a step for a state on a GPU: on the CPU, to the CPU's bits; and what stays on
the GPU. The GPU is a pretended one; `tests/test_cuda.py` runs the same on a real one."""

from __future__ import annotations

import pickle
from dataclasses import dataclass, replace
from typing import NamedTuple

import pytest
import torch
from helpers import step
from mock_cuda import pretended_cuda  # noqa: F401
from test_devices import SMALL, STEPS, columns

import torchfilm as tf
from torchfilm.cpu_parts import Copies, OnCpu
from torchfilm.parameters import parameters


def by_kernels(model: tf.Model) -> list[str]:
    """The titles of what is computed on the CPU."""
    return [part.title for part in model.step_parts if isinstance(part, OnCpu)]


def check_same(there: tf.State, here: tf.State) -> None:
    assert there.cells == here.cells
    made = columns(there)
    for name, right in columns(here).items():
        assert made[name].device.type == "cuda", name
        assert torch.equal(made[name].cpu(), right), name


@torch.no_grad()
def check_bits_of_the_cpu(name: str) -> None:
    """What the kernels of a ready scene compute is the same on both, step by step, and what is told
    of the last step is on the GPU."""
    scene = tf.scenes.build(name, SMALL.get(name))
    there, here = (scene.bind(2, seed=1, device=device) for device in ("cuda", "cpu"))
    assert by_kernels(there)
    a, b = there.start(), here.start()
    ended = births = 0
    for _ in range(STEPS[name]):
        a, b = there.step(a), here.step(b)
        check_same(a, b)
        ended, births = ended + len(a.ended), births + len(a.births)
        for one, other in zip(a.ended, b.ended, strict=True):
            assert one.uid.device.type == "cuda" and torch.equal(one.uid.cpu(), other.uid)
        for one, other in zip(a.births, b.births, strict=True):
            check_same(one.parents, other.parents)
            assert torch.equal(one.first.cpu(), other.first)
        assert a.reports.keys() == b.reports.keys()
        for report in a.reports.values():
            assert all(x.device.type == "cuda" for _, x in parameters(report))
    assert births or STEPS[name] < 20, "no cell has divided"


@pytest.mark.slow
@pytest.mark.parametrize("name", STEPS)
def test_a_ready_scene_has_the_bits_of_the_cpu(pretended_cuda, name):  # noqa: F811
    check_bits_of_the_cpu(name)


def colony(*more: tf.Effect, **mechanics) -> tf.Scene:
    """Colonies that divide within ten steps."""
    return tf.Scene(
        tf.Growth(rate=[1.0, 1.5]), tf.Division(length=tf.Uniform(2.2, 2.6)),
        tf.Mechanics(dim=2, **mechanics), *more, dt=0.05, dim=2,
    )  # fmt: skip


def run(scene: tf.Scene, device: str, steps: int = 12) -> tf.State:
    state = scene.bind(2, device=device).start()
    for _ in range(steps):
        state = step(scene, state, scene.dt)
    return state


@dataclass(frozen=True)
class Mark(tf.Effect):
    """Marks daughters with their uid, times a number for each colony."""

    title, stage = "mark", 3
    by: float = tf.physical(2.0)

    def declares(self, dim):
        def first(state, rows, values):
            by = values.by.of_colonies(state).index_select(0, state.colony)
            return (state.uid * by).index_select(0, rows)

        return [tf.Field("mark", "what daughters begin with", initial=first, at_division="reset")]

    def reads(self):
        return ["mark"]

    writes = reads

    def step(self, state, dt, values):
        return state.with_fields(mark=state.mark + 0.0)


def test_first_values_of_own_effects_and_rules_are_found_on_the_gpu(pretended_cuda):  # noqa: F811
    """Divisions are on the CPU."""
    seen = set()

    def look(cells):
        seen.add(cells.mood.device.type)
        cells.mood = cells.mood + cells.normal()

    scene = colony(tf.Rules(look, variables={"mood": 0.0}), Mark(by=[2.0, 3.0]))
    there = run(scene, "cuda")
    assert seen == {"cuda"}
    check_same(there, run(scene, "cpu"))
    by = torch.tensor([2.0, 3.0])[there.colony.cpu()]
    assert there.cells > 2 and torch.equal(there.mark.cpu(), by * there.uid.cpu())


def test_a_circuit_of_tensors_on_the_gpu_stays_there(pretended_cuda):  # noqa: F811
    matrix = torch.tensor([[0.5, 0.1], [0.2, 0.3]]).to("cuda")

    def rates(u, s, p, cell):
        made = torch.stack([u.a, u.b], 1) @ matrix
        return {"a": 1.0 + made[:, 0] - u.a, "b": 1.0 - made[:, 1]}

    circuit = tf.Circuit(rates, species=("a", "b"), steps=2, method="rk4")
    scene = colony(circuit)
    model = scene.bind(2, device="cuda")
    assert by_kernels(model) == ["growth", "mechanics"]
    told = str(tf.explain(scene, device="cuda", seconds=0))
    assert (
        "on cuda:0, by torch: circuit, division; circuit: it fails on the CPU, mul: tensors on cuda"
        in told
    )
    assert "on the CPU: growth, mechanics; the state stays on cuda:0" in told
    state = model.step(model.start())
    assert float(state.b.min()) > 0 and state.b.device.type == "cuda"
    with pytest.raises(tf.InputError, match=r"backend = 'compiled', but kernels are for the CPU"):
        colony(replace(circuit, backend="compiled")).bind(2, device="cuda")


def test_parents_of_daughters_that_share_molecules_are_on_the_gpu(pretended_cuda):  # noqa: F811
    circuit = tf.Circuit([tf.Reaction({}, {"m": 1}, 1.0)], species=("m",), daughters="amount")
    scene, told = colony(circuit), 0
    state = scene.bind(2, device="cuda").start()
    for _ in range(12):
        state = step(scene, state, scene.dt)
        for births in state.births:
            told += births.rows.numel()
            assert births.parents.m.device.type == births.first.device.type == "cuda"
    assert told


class Own(tf.Uniform):
    """A distribution that may hold tensors on the GPU."""


def test_distributions_of_ones_own_stay_on_the_gpu(pretended_cuda):  # noqa: F811
    scene = tf.Scene(tf.Growth(rate=1.0), tf.Division(length=Own(2.2, 2.6)), tf.Mechanics(dim=2),
                     dt=0.05, dim=2)  # fmt: skip
    model = scene.bind(2, device="cuda")
    assert by_kernels(model) == ["growth", "mechanics"]
    assert "by torch: division; division: Own is a distribution of your own" in str(
        tf.explain(scene, device="cuda", seconds=0)
    )
    there, here = run(scene, "cuda"), run(scene, "cpu")
    assert there.cells > 2 and torch.allclose(there.length.cpu(), here.length, rtol=1e-5)


def test_torch_computes_on_the_gpu_where_it_is_asked_for(pretended_cuda):  # noqa: F811
    scene = colony(backend="torch")
    model = scene.bind(2, device="cuda")
    assert model.twins is None and "the CPU" not in str(tf.explain(scene, device="cuda", seconds=0))


def test_torch_computes_on_the_gpu_where_a_derivative_is_wanted(pretended_cuda):  # noqa: F811
    """And kernels again in the next step without. (`test_cuda` looks at the derivatives.)"""
    rate = torch.tensor([1.0, 1.5], dtype=torch.float64, requires_grad=True)
    growth = tf.Growth(rate=rate.to("cuda"))
    others = tf.Division(length=2.4), tf.Mechanics(dim=2, tolerance=1e-6)
    scene = tf.Scene(growth, *others, dim=2)
    model = scene.bind(2, device="cuda", dtype=torch.float64)
    state = model.step(model.start(), 0.05)
    assert model.twins.derivatives_wanted(state) and state.length.requires_grad
    with torch.no_grad():
        assert not model.twins.derivatives_wanted(state)
        after = model.step(state, 0.05)
    assert not after.length.requires_grad
    same = tf.Scene(tf.Growth(rate=rate.detach()), *others, dim=2).bind(2, dtype=torch.float64)
    with torch.no_grad():
        assert torch.equal(same.step(state.to("cpu"), 0.05).position, after.position.cpu())


def test_what_does_not_change_is_copied_once(pretended_cuda):  # noqa: F811
    copies = Copies(torch.device("cuda:0"))
    there = torch.arange(3.0).to("cuda")
    here = copies.here(there)
    assert here.device.type == "cpu" and copies.here(there) is here
    assert copies.there(here) is there
    there.add_(1.0)  # in place: the copy is of what it was
    assert copies.here(there) is not here and copies.here(there).tolist() == [1.0, 2.0, 3.0]
    made = torch.zeros(2)
    assert copies.here(copies.there(made)) is made
    with torch.inference_mode():
        frozen = torch.arange(3.0).to("cuda")
    assert copies.here(frozen) is not copies.here(frozen)


def test_tensors_that_are_sent_together_do_not_travel_again(pretended_cuda):  # noqa: F811
    copies = Copies(torch.device("cuda:0"))
    many = [torch.arange(6.0).reshape(2, 3), torch.zeros(0), torch.tensor([True, False])]
    many += [torch.arange(3), torch.arange(4.0)[::2], torch.ones((), dtype=torch.float64)]
    kept = copies.send([*many, many[0], "no tensor"])
    assert len(kept) == len(many)
    for here in many:
        (there,) = (x for x in kept if x is copies.there(here))
        assert there.device.type == "cuda" and there.dtype == here.dtype
        assert torch.equal(there.cpu(), here) and copies.here(there) is here


def test_copies_of_the_last_state_only_are_kept(pretended_cuda):  # noqa: F811
    model = colony().bind(2, device="cuda")
    states = [model.start()]
    for _ in range(8):
        states.append(model.step(states[-1]))
    alive = [known() for known, _ in model.twins.copies._here.values() if known() is not None]
    last = model.twins.last
    left = last.reports["mechanics"].left  # the cells before some divided
    of_last = {id(x) for s in (last, left) for x in (*columns(s).values(), *vars(s).values())}
    assert len(alive) > 5 and all(id(x) in of_last for x in alive if x.dim() and len(x) > 2)


def test_no_tensor_of_a_step_is_sent_by_itself(pretended_cuda, monkeypatch):  # noqa: F811
    model = colony().bind(2, device="cuda")
    state = model.step(model.start())
    noted, there, made, alone = Copies._noted, Copies.there, [], []

    def counted(self, part):
        before = len(made)
        found = there(self, part)
        alone.extend(made[before:])
        return found

    monkeypatch.setattr(Copies, "_noted", lambda self, *pair: made.append(1) or noted(self, *pair))
    monkeypatch.setattr(Copies, "there", counted)
    model.step(state)
    assert len(made) > 5 and not alone


def test_a_field_that_is_edited_in_place_is_seen(pretended_cuda):  # noqa: F811
    scene = colony()
    there, here = (scene.bind(2, device=device) for device in ("cuda", "cpu"))
    a, b = there.step(there.start()), here.step(here.start())
    for state in (a, b):
        state.growth_rate.mul_(2.0)
    check_same(there.step(a), here.step(b))


def test_a_replay_has_the_bits_of_the_cpu(pretended_cuda):  # noqa: F811
    scene = tf.scenes.build("boundary_detector")
    found = []
    for device in ("cuda", "cpu"):
        recording = tf.GrowthRecording(scene, streams=[0, 1], device=device)
        replay = tf.Replay(scene.bind(2, device=device), recording)
        state = replay.start()
        for _ in range(3):
            state = replay.step(state)
        found.append(state)
    check_same(*found)


BOX = {"box": ((-20.0, -20.0), (20.0, 20.0)), "spacing": 4.0, "depth": 1.0}


def test_reports_of_exchange_in_turns_are_on_the_gpu(pretended_cuda):  # noqa: F811
    """A run looks at how they swing; groups of cells are among them."""
    scene = colony(
        tf.Circuit(lambda u, s, p, cell: ({"m": 1.0 - u.m}, {"n": -0.1 * s.n * cell.volume}),
                   species=("m",)),
        tf.Medium(n=tf.Signal(50.0, initial=5.0), exchange="turns", steps=2, **BOX),
    )  # fmt: skip
    *_, state = tf.simulate(scene, until=0.2, colonies=2, device="cuda")
    exchanged = state.reports["circuit"].exchanged
    assert exchanged.groups.owner.device.type == exchanged.pool.device.type == "cuda"
    assert exchanged.groups.sum(exchanged.pool.unsqueeze(1)).device.type == "cuda"


@pytest.mark.parametrize("where", ["source", "decay", "flow"])
def test_derivatives_by_what_a_function_of_positions_holds_pass(pretended_cuda, where):  # noqa: F811
    slope = torch.tensor(0.7, dtype=torch.float64, requires_grad=True)
    law = lambda x: slope.to(x.device) * (1.0 + 0.0 * x[:, 0])
    if where == "flow":
        law = lambda x: slope.to(x.device) * torch.ones_like(x)
    signal = tf.Signal(50.0, initial=1.0, **{where: law})
    model = colony(tf.Medium(a=signal, **BOX)).bind(2, device="cuda", dtype=torch.float64)
    state = model.step(model.step(model.start()))
    assert state.signals["a"].requires_grad
    with torch.no_grad():
        assert not model.step(state).signals["a"].requires_grad


def test_derivatives_that_show_late_pass(pretended_cuda):  # noqa: F811
    """Far from the origin only, or wanted since the scene was bound."""
    held = torch.tensor(0.7, dtype=torch.float64)

    def law(x):
        far = x[:, 0] > 15.0
        return torch.where(far, held.to(x.device), 0.0) if bool(far.any()) else 0.0 * x[:, 0]

    scene = colony(tf.Medium(a=tf.Signal(50.0, source=law), **BOX))
    model = scene.bind(2, device="cuda", dtype=torch.float64)
    held.requires_grad_(True)
    assert model.step(model.start()).signals["a"].requires_grad
    again = scene.bind(2, device="cuda", dtype=torch.float64)
    assert again.step(again.start()).signals["a"].requires_grad


def test_functions_that_hold_in_their_box_only_are_by_kernels(pretended_cuda):  # noqa: F811
    def law(x):
        assert float(x.min()) > -21.0 and float(x[:, 0].min()) > 9.0
        return x[:, 0]

    box = {**BOX, "box": ((10.0, -20.0), (42.0, 20.0))}
    scene = colony(tf.Medium(a=tf.Signal(50.0, source=law), outside="reservoir", **box))
    assert not scene.bind(2, device="cuda").twins.kept


@pytest.mark.parametrize("where", ["source", "decay", "initial", "flow"])
def test_functions_of_tensors_on_the_gpu_stay_there(pretended_cuda, where):  # noqa: F811
    held = torch.tensor([0.5, 1.0, 0.0], dtype=torch.float64).to("cuda")
    law = lambda x: (x * held).sum(1).abs()
    if where == "flow":
        law = lambda x: held.expand(x.shape)
    medium = tf.Medium(a=tf.Signal(50.0, **{where: law}), **BOX)
    model = colony(medium).bind(2, device="cuda")
    assert "transport" in model.twins.kept and "mechanics" in by_kernels(model)
    state = model.step(model.start())
    assert state.signals["a"].device.type == "cuda"
    with pytest.raises(tf.InputError, match=r"Medium.backend = 'compiled', but kernels are for"):
        colony(replace(medium, backend="compiled")).bind(2, device="cuda")


def test_schedules_are_no_functions_of_positions(pretended_cuda):  # noqa: F811
    around = tf.BoundaryConditions(x=tf.Periodic(), y=tf.Periodic())
    flow = tf.Schedule({0.0: (1.0, 0.0), 0.3: (40.0, 0.0)})
    scene = colony(tf.Medium(a=tf.Signal(5.0, source=lambda x: 1.0 * (x[:, 0] > 0)), flow=flow,
                             boundary=around, **BOX))  # fmt: skip
    assert not scene.bind(2, device="cuda").twins.kept
    check_same(run(scene, "cuda"), run(scene, "cpu"))


def test_fields_that_are_declared_on_a_state_start_on_the_gpu(pretended_cuda):  # noqa: F811
    scene = colony()
    model = scene.bind(2, device="cuda")
    first = lambda state, rows: 7.0 * torch.ones(rows.numel(), device="cuda")
    tag = tf.Field("tag", "of daughters", at_division="reset", initial=first)
    state = model.start().declare(tag)
    for _ in range(12):
        state = model.step(state)
    assert state.cells > 2 and state.tag.tolist() == [7.0] * state.cells


class Told(NamedTuple):
    status: torch.Tensor
    hint: str

    def reason(self, place: int) -> str:
        return "none"


@dataclass(frozen=True)
class Tells(tf.Effect):
    title, stage = "tells", 5

    def step(self, state, dt, values):
        told = Told(torch.zeros_like(state.counts), "x")
        return state.replace(reports={**state.reports, "tells": told})


def test_reports_of_ones_own_stay_what_they_are(pretended_cuda):  # noqa: F811
    *_, state = tf.simulate(colony(Tells()), until=0.1, colonies=2, device="cuda")
    assert type(state.reports["tells"]) is Told and state.reports["tells"].hint == "x"


class HiddenPlane(tf.Plane):
    """A wall whose place hides in a tensor on the GPU."""

    def surfaces(self, dim):
        (surface,) = super().surfaces(dim)
        moved = surface.offset + torch.zeros(()).to("cuda")
        return [replace(surface, offset=moved)]


def test_walls_of_tensors_on_the_gpu_stay_there(pretended_cuda):  # noqa: F811
    walls = [HiddenPlane(y=-5.0, facing="+y")]
    scene = tf.Scene(tf.Growth(rate=1.0), tf.Mechanics(walls=walls, dim=2), dt=0.05, dim=2)
    model = scene.bind(2, device="cuda")
    assert model.twins is None  # nothing is left that is worth the way
    assert model.step(model.start()).position.device.type == "cuda"


def test_what_binding_warns_of_is_said_once(pretended_cuda):  # noqa: F811
    box = {**BOX, "box": ((-20.0, 0.0), (20.0, 20.0))}
    medium = tf.Medium(a=tf.Signal(50.0, source=1.0), outside="grow", **box)
    scene = colony(medium, walls=[tf.Plane(y=0.0, facing="+y")])
    with pytest.warns(UserWarning, match="the box grows through the wall") as said:
        scene.bind(cells=tf.Cells([[0.0, 2.0]], [[1.0, 0.0]]), colonies=2, device="cuda")
    assert len(said) == 1


def test_what_happened_before_a_division_is_on_the_gpu(pretended_cuda):  # noqa: F811
    scene = colony(tf.Medium(a=tf.Signal(50.0, source=1.0), **BOX))
    model = scene.bind(2, device="cuda")
    state, seen = model.start(), 0
    for _ in range(12):
        state = model.step(state)
        for births in state.births:
            seen += 1
            for report in births.before.reports.values():
                assert all(x.device.type == "cuda" for _, x in parameters(report))
    assert seen


def test_a_model_can_be_copied_and_a_step_without_change_returns_its_state(
    pretended_cuda,  # noqa: F811
):
    model = colony().bind(2, device="cuda")
    state = model.step(model.start())
    again = pickle.loads(pickle.dumps(model.twins.copies))
    assert torch.equal(again.here(state.length), state.length.cpu())
    division = next(part for part in model.step_parts if part.title == "division")
    assert isinstance(division, OnCpu) and division.run_step(state, 0.05) is state
