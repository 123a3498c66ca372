"""Long runs with gradients: what a rollout keeps, and what may not change before the way back."""

from __future__ import annotations

import gc

import pytest
import torch

import torchfilm as tf
from torchfilm.physics.adjoint import _AdjointSolve
from torchfilm.tools.segments import Segment, _sum_of_bits, keep, kept, no_segment
from torchfilm.tools.tangents import outside_checkpoints

F64 = torch.float64
BOX = {"box": ((-16, -16), (16, 16)), "spacing": 4.0}


def talking(u, s, p, cell):
    return {"a": p.k - u.a + s.out}, {"out": cell.area * (u.a - s.out)}


def pushing(rate, contacts="one-sided") -> tf.Scene:
    mechanics = tf.Mechanics(dim=2, tolerance=1e-7, contacts=contacts)
    founders = tf.inoculum(12, radius=5.0, seed=0)
    return tf.Scene(tf.Growth(rate=rate), mechanics, founders=founders, dt=0.05)


def exchanging(k, diffusion=10.0, flow=None) -> tf.Scene:
    out = tf.Signal(diffusion=diffusion, decay=0.5)
    medium = tf.Medium(out=out, **BOX, **({} if flow is None else {"flow": flow}))
    founders = tf.inoculum(5, radius=5.0, seed=0)
    circuit = tf.Circuit(talking, species="a", k=k)
    return tf.Scene(tf.Growth(rate=0.3), circuit, medium, founders=founders, dim=2, dt=0.05)


def skew(x):
    return torch.stack([20.0 * (1 - (x[:, 1] / 16) ** 2), 0 * x[:, 1], 0 * x[:, 1]], 1)


CASES = {
    "contacts": (pushing, lambda end: end.position.square().sum()),
    "bilateral": (lambda x: pushing(x, "bilateral"), lambda end: end.position.square().sum()),
    "exchange": (exchanging, lambda end: end.a.sum()),
    "solved": (lambda x: exchanging(x, 1e5, skew), lambda end: end.a.sum()),
}


def left(kind: type) -> int:
    """How many objects of a kind there are."""
    gc.collect()
    return sum(type(x) is kind for x in gc.get_objects())


@pytest.mark.parametrize("case", CASES)
def test_gradients_whatever_the_segment(case):
    made, measure = CASES[case]
    x, slopes = torch.tensor(0.8, dtype=F64, requires_grad=True), []
    for segment in (None, 1, 3):
        end = tf.rollout(made(x).bind(dtype=F64), until=0.4, segment=segment)
        loss = measure(end)
        once, again = (torch.autograd.grad(loss, x, retain_graph=r)[0] for r in (True, False))
        assert torch.equal(once, again)
        slopes.append(once)
    assert torch.allclose(slopes[0], slopes[1], rtol=1e-12)
    ends = [measure(tf.rollout(made(y).bind(dtype=F64), until=0.4)) for y in (0.8001, 0.7999)]
    assert float(slopes[0]) == pytest.approx(float(ends[0] - ends[1]) / 2e-4, rel=1e-3)
    assert torch.equal(slopes[1], slopes[2]) and abs(float(slopes[0])) > 1e-3


@pytest.mark.usefixtures("new_objects")
def test_no_contact_problem_is_kept():
    x, counts = torch.tensor(0.8, dtype=F64, requires_grad=True), []
    for segment in (None, 4):
        model = pushing(x).bind(dtype=F64)
        end = tf.rollout(model, until=0.4, segment=segment)
        counts.append(left(_AdjointSolve))
        end.position.sum().backward()
        counts.append(left(_AdjointSolve))
        del end, model
    assert counts[0] >= 8 and counts[2:] == [0, 0]


@pytest.mark.usefixtures("new_objects")
@pytest.mark.parametrize("case", ["exchange", "solved"])
def test_nothing_is_kept_after_a_gradient_that_does_not_reach_all(case):
    """That of lengths does not need exchange, which was done again for it all the same."""
    for k in range(3):
        rate = torch.tensor(0.3, dtype=F64, requires_grad=True)
        scene = CASES[case][0](1.0)
        scene = scene.replace(tf.Growth(rate=rate), *scene.effects[1:])
        end = tf.rollout(scene.bind(dtype=F64), until=0.4, segment=4)
        for _ in range(2):
            torch.autograd.grad(end.length.sum(), rate, retain_graph=True)
        segments = [x for x in gc.get_objects() if type(x) is Segment]
        assert segments and not any(x._things for x in segments)
        (end.a.sum() + end.length.sum()).backward()
        del end, scene, segments
        assert not left(Segment), k


class Doubled(torch.autograd.Function):
    @staticmethod
    def forward(ctx, x, things):
        keep(ctx, things, x)
        return 2 * x

    @staticmethod
    def backward(ctx, back):
        things, (x,) = kept(ctx)
        things.append(float(x))
        return 2 * back, None


def test_things_are_kept_in_the_second_run_of_a_segment():
    x, segment, runs = torch.tensor(3.0, requires_grad=True), Segment(), []

    def steps(x):
        with segment.steps() as again:
            runs.append((again, ["made here"]))
            return Doubled.apply(Doubled.apply(x, runs[-1][1]), runs[-1][1])

    y = torch.utils.checkpoint.checkpoint(steps, x, use_reentrant=False)
    assert [again for again, _ in runs] == [False] and not segment._things
    for number in (1, 2):
        (slope,) = torch.autograd.grad(y, x, retain_graph=True)
        assert float(slope) == 4.0 and len(runs) == 1 + number and not segment._things
        assert runs[0] == (False, ["made here"])
        assert runs[number] == (True, ["made here", 6.0, 3.0])


def test_things_are_kept_outside_of_a_segment():
    x, things = torch.tensor(3.0, requires_grad=True), []
    Doubled.apply(x, things).backward()
    with Segment().steps(), no_segment():
        y = Doubled.apply(x, things)
    y.backward()
    assert things == [3.0, 3.0]
    with Segment().steps(), outside_checkpoints():
        y = Doubled.apply(x, things)
    y.backward()
    assert things == [3.0, 3.0, 3.0]


# --- what changes before the way back -------------------------------------------------------------


def controlled(net) -> tf.Scene:
    def rates(u, s, p, cell):
        return {"a": net(u.a[:, None])[:, 0] - u.a}

    circuit = tf.Circuit(rates, species="a", initial={"a": 1.0}, method="heun2")
    return tf.Scene(tf.Growth(rate=0.3), circuit, dim=2, dt=0.1)


def test_weights_that_change_before_the_gradient_are_refused():
    torch.manual_seed(0)
    net = torch.nn.Sequential(torch.nn.Linear(1, 3), torch.nn.Tanh(), torch.nn.Linear(3, 1))
    rule = torch.optim.SGD(net.parameters(), 0.1)
    for _ in range(2):
        rule.zero_grad()
        end = tf.rollout(controlled(net), until=0.6, segment=2)
        end.a.sum().backward()  # as it should be
        rule.step()
    end = tf.rollout(controlled(net), until=0.6, segment=2)
    rule.step()
    with pytest.raises(tf.InputError, match=r"changed since rollout began.*segment=None"):
        end.a.sum().backward()
    weight = torch.ones(1, requires_grad=True)
    end = tf.rollout(controlled(lambda x: weight * x), until=0.6, segment=2)
    with torch.no_grad():
        weight.mul_(2.0)
    with pytest.raises(tf.InputError, match="changed since rollout began"):
        end.a.sum().backward()


@pytest.mark.parametrize("what", ["a global", "a tensor", "a memory", "a memory in the graph"])
def test_what_a_rule_reads_must_not_change_before_the_gradient(what):
    light, tensor = [torch.ones((), dtype=F64)], torch.ones((), dtype=F64)

    def shine(cells):
        if what.startswith("a memory"):  # of a controller
            found = light[0] + 0.1 * (1 - cells.a).mean()
            light[0] = found if what.endswith("graph") else found.detach()
        cells.light = torch.ones_like(cells.a) * (tensor if what == "a tensor" else light[0])

    make = torch.tensor(4.0, dtype=F64, requires_grad=True)
    model = tf.Scene(
        tf.Rules(shine, variables={"light": 0.0}),
        tf.Circuit(lambda u, s, p, cell: {"a": p.k * cell.light - u.a}, species="a", k=make),
        dim=2, dt=0.1,
    ).bind(dtype=F64)  # fmt: skip
    model.start()
    light[0] = torch.ones((), dtype=F64)
    end = tf.rollout(model, until=0.6, segment=2)
    if what == "a global":
        light[0] = torch.zeros((), dtype=F64)
    elif what == "a tensor":
        tensor.fill_(0.0)
    with pytest.raises(tf.InputError, match=r"does its steps again, and the step to 0.5 h ended"):
        end.a.sum().backward()


@pytest.mark.parametrize(("until", "segment"), [(0.2, 1), (0.1, 10), (0.3, 3)])
@pytest.mark.parametrize("founders", [1, 64])
def test_the_last_step_of_a_segment_is_compared_too(until, segment, founders):
    """Also where all cells have the same numbers, and little else changes."""
    light, weight = [1.0], torch.tensor(2.0, dtype=F64, requires_grad=True)

    def shine(cells):
        cells.light = (cells.time > until - 0.15) * weight * light[0] * torch.ones_like(cells.light)

    places = [[3.0 * k, 0.0] for k in range(founders)]
    scene = tf.Scene(
        tf.Rules(shine, variables={"light": 0.0}), tf.Growth(rate=0.0), dt=0.1,
        founders=tf.Cells(places, [[0.0, 1.0]] * founders, 2.0),
    )  # fmt: skip
    end = tf.rollout(scene.bind(dtype=F64), until=until, segment=segment)
    assert (end.light == 2.0).all()
    light[0] = 0.0
    with pytest.raises(tf.InputError, match=f"the step to {until:g} h ended otherwise"):
        end.light.sum().backward()


def test_rollouts_of_no_cells_end():
    model = tf.Scene(tf.Growth(rate=1.0), dim=2, dt=0.1).bind()
    state = model.start()
    empty = state.remove(torch.ones(1, dtype=torch.bool), "removed")
    assert tf.rollout(model, empty, until=0.3).cells == 0


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32, torch.int64, torch.bool])
def test_sums_of_bits_tell_numbers_their_order_and_their_count(dtype):
    given = [torch.full((n,), x) for n in (0, 1, 3, 64, 128, 4096) for x in (0, 1)]
    given += [torch.tensor(x) for x in ([0, 1], [1, 0], [1, 1, 0], [0, 1, 1], [1, 0, 1])]
    sums = [int(_sum_of_bits(x.to(dtype))) for x in given]
    assert len(set(sums)) == len(sums) - 1  # the two of no numbers are alike


def test_steps_that_repeat_give_their_gradient_twice():
    make = torch.tensor(4.0, dtype=F64, requires_grad=True)
    circuit = tf.Circuit(lambda u, s, p, cell: {"a": p.k - u.a}, species="a", k=make)
    scene = tf.Scene(tf.Growth(rate=1.0), tf.Division(length=3.0), circuit, dim=2, dt=0.1)
    end = tf.rollout(scene, until=2.0, segment=3)
    assert end.cells > 1
    first, second = (torch.autograd.grad(end.a.sum(), make, retain_graph=True) for _ in range(2))
    assert torch.equal(first[0], second[0]) and float(first[0]) > 0


# --- where a first state comes from ---------------------------------------------------------------


def test_a_first_state_that_is_edited_in_place_leaves_the_model_as_it_is():
    circuit = tf.Circuit(lambda u, s, p, cell: {"a": 1 - u.a}, species="a")
    growth = tf.Growth(rate=1.0), tf.Division(length=3.5)
    model = tf.Scene(*growth, circuit, tf.Medium(**BOX, out=tf.Signal(diffusion=1.0)), dim=2).bind()
    first = model.start()
    plain = first.replace(fields={n: x.clone() for n, x in first.fields.items()})
    for value in (*first.fields.values(), first.position, first.length, first.radius):
        if value.is_floating_point():
            value.fill_(5.0)
    again = model.start()
    assert all(torch.equal(again.fields[n], x) for n, x in plain.fields.items())
    assert float(again.radius[0]) == 0.5 and "growth_rate" in plain.fields


@pytest.mark.parametrize("case", ["contacts", "exchange"])
def test_a_model_that_is_bound_in_inference_mode_gives_gradients_later(case):
    made, measure = CASES[case]
    x = torch.tensor(0.8, dtype=F64, requires_grad=True)
    with torch.inference_mode():
        model = made(x).bind(dtype=F64)
    (slope,) = torch.autograd.grad(measure(tf.rollout(model, until=0.4)), x)
    (plain,) = torch.autograd.grad(measure(tf.rollout(made(x).bind(dtype=F64), until=0.4)), x)
    assert torch.equal(slope, plain) and float(slope) != 0.0
