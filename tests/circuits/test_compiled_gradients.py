"""Gradients through stiff circuits that are compiled: against torch's own graph of the same steps,
and whether a cell's depend on the cells beside it."""

from __future__ import annotations

import pytest
import torch
from traced import by

import torchfilm as tf
from torchfilm.circuits import compiled_gradients, rosenbrock
from torchfilm.tools.tangents import forward_mode, tangent, with_tangent

F64 = torch.float64
CONSTANTS = {"k": 3.0, "cut": 0.7}
# With these a first step of `roots` ends below 0.
LONG = {"rtol": 0.1, "atol": 0.1, "initial": {"a": 0.5, "b": 5.0}}


def rates(u, s, p, cell):
    made = p.k * u.b**2 / (p.cut + u.b**2) + 0.2 * cell.volume
    return {"a": made - 4 * u.a, "b": 30 * u.a - p.k * u.b}


def roots(u, s, p, cell):
    """In long steps they end below 0, and are corrected."""
    meets = 60 * p.cut * u.a * u.b
    return {"a": p.k - p.k * u.a**0.5 - meets, "b": p.k * u.a - meets}


def scene(given, constants, **circuit) -> tf.Scene:
    cells = tf.Cells([[5.0 * k, 0.0] for k in range(3)], [[1.0, 0.0]] * 3, length=[2.0, 2.5, 3.0])
    circuit = {"initial": {"a": 2.0, "b": 0.5}} | circuit
    return tf.Scene(
        tf.Growth(rate=0.6), tf.Circuit(given, species=("a", "b"), **circuit, **constants),
        founders=cells, dim=2, dt=0.2,
    )  # fmt: skip


def requiring(values=CONSTANTS, dtype=F64) -> dict[str, torch.Tensor]:
    return {n: torch.tensor(x, dtype=dtype, requires_grad=True) for n, x in values.items()}


def gradients(backend, given=rates, constants=None, colonies=1, only=None, steps=3, **circuit):
    """The end, and gradients by the constants and by what there was of each species."""
    constants = constants or requiring()
    dtype = next(iter(constants.values())).dtype
    described = by(backend, scene(given, constants, **circuit))
    model = described.bind(colonies, dtype=dtype, per_colony=True)
    state = model.start()
    first = {n: state.fields[n].detach().clone().requires_grad_() for n in ("a", "b")}
    state = state.with_fields(**first)
    state = state if only is None else state.select([only])
    for _ in range(steps):
        state = model.step(state, 0.3)
    end = torch.stack([state.fields["a"], state.fields["b"]])
    loss = (end * torch.arange(1.0, 1 + end.numel(), dtype=dtype).view_as(end)).sum()
    found = torch.autograd.grad(loss, [*constants.values(), *first.values()])
    return end.detach(), dict(zip([*constants, *first], found, strict=True))


@pytest.fixture
def by_kernels_only(monkeypatch):
    def refused(*_args, **_kwargs):
        raise AssertionError("torch took the steps")

    monkeypatch.setattr(rosenbrock, "rodas3", refused)


@pytest.mark.parametrize("given", [rates, roots])
def test_they_are_those_of_torchs_graph(plain, given):
    settings = LONG if given is roots else {}
    end, ours = gradients("compiled", given, **settings)
    other, theirs = gradients("torch", given, **settings)
    assert torch.allclose(end, other, rtol=1e-12)
    for name, slope in ours.items():
        assert float(slope.abs().max()) > 0, name
        assert torch.allclose(slope, theirs[name], rtol=1e-9, atol=1e-12), name


def test_the_correction_below_zero_is_tried(plain, monkeypatch):
    """That `roots` ends below 0, without which the test above would not try the correction."""
    met, before = [], rosenbrock._Tableau._enforce_nonnegative

    def noted(self, u, k1, new, *rest):
        met.append(bool((new < 0).any()))
        return before(self, u, k1, new, *rest)

    monkeypatch.setattr(rosenbrock._Tableau, "_enforce_nonnegative", noted)
    gradients("torch", roots, **LONG)
    assert any(met)


def test_kernels_take_the_steps(plain, by_kernels_only):
    gradients("compiled")
    with pytest.raises(AssertionError, match="torch took"):
        gradients("torch")


def test_each_colony_has_its_own_constants(plain):
    values = {"k": [3.0, 2.0, 1.5], "cut": [0.7, 0.5, 0.9]}
    _, ours = gradients("compiled", constants=requiring(values), colonies=3)
    _, theirs = gradients("torch", constants=requiring(values), colonies=3)
    for name in values:
        assert ours[name].shape == (3,)
        assert torch.allclose(ours[name], theirs[name], rtol=1e-9), name


def test_numbers_of_float32_have_gradients_of_float32(plain):
    _, ours = gradients("compiled", constants=requiring(dtype=torch.float32))
    _, theirs = gradients("torch", constants=requiring(dtype=torch.float32))
    for name, slope in ours.items():
        assert slope.dtype == torch.float32
        assert torch.allclose(slope, theirs[name], rtol=1e-4), name


def test_a_cells_do_not_depend_on_others(plain):
    values = {"k": [3.0, 2.0, 1.5], "cut": [0.7, 0.5, 0.9]}
    ends, slopes = [], []
    for only in (None, 1):
        constants = requiring(values)
        described = by("compiled", scene(rates, constants))
        model = described.bind(3, dtype=F64, per_colony=True)
        state = model.start() if only is None else model.start().select([only])
        for _ in range(3):
            state = model.step(state, 0.3)
        own = state if only is not None else state.select([1])
        slopes.append(torch.autograd.grad(own.fields["a"].sum(), list(constants.values())))
        ends.append(own.fields["a"].detach())
    assert torch.equal(*ends)
    assert all(torch.equal(a[1], b[1]) for a, b in zip(*slopes, strict=True))


@pytest.mark.parametrize("at_once", [1, 7, 1 << 17])
def test_cells_worked_on_at_once_change_no_bits(plain, monkeypatch, at_once):
    _, first = gradients("compiled")
    monkeypatch.setattr(compiled_gradients, "AT_ONCE", at_once)
    _, ours = gradients("compiled")
    assert all(torch.equal(ours[n], first[n]) for n in first)


def test_one_constant_of_two(plain, by_kernels_only):
    """The other, a plain number, has no gradient and stays one number for all."""
    both = gradients("compiled")[1]
    k = requiring()["k"]
    only = gradients("compiled", constants={"k": k}, cut=0.7)[1]
    assert torch.allclose(only["k"], both["k"], rtol=1e-12)


def test_with_too_many_numbers_torch_takes_the_steps(plain, monkeypatch):
    _, ours = gradients("compiled")
    monkeypatch.setattr(compiled_gradients, "MOST_DIRECTIONS", 3)
    taken, before = [], rosenbrock.rodas3
    monkeypatch.setattr(rosenbrock, "rodas3", lambda *a, **k: taken.append(1) or before(*a, **k))
    _, theirs = gradients("compiled")
    assert len(taken) == 3
    assert all(torch.allclose(ours[n], theirs[n], rtol=1e-9) for n in ours)


def test_second_derivatives_are_refused(plain):
    k = torch.tensor(3.0, dtype=F64, requires_grad=True)
    model = by("compiled", scene(rates, {"k": k, "cut": 0.7})).bind(dtype=F64)
    end = model.step(model.start(), 0.3).fields["a"].sum()
    with pytest.raises(RuntimeError, match="no second derivatives through the stiff method"):
        torch.autograd.grad(end, k, create_graph=True)


def test_both_kinds_of_derivative_at_once_are_left_to_torch(plain):
    """A tangent and a gradient, as of the direction of a gradient: by torch alone."""
    from torchfilm.tools.tangents import both, forward_mode, with_tangent

    k = torch.tensor(3.0, dtype=F64, requires_grad=True)
    model = by("compiled", scene(rates, {"k": k, "cut": 0.7})).bind(dtype=F64)
    with forward_mode():
        state = model.start()
        moved = with_tangent(state.fields["a"].clone(), torch.ones(3, dtype=F64))
        end = model.step(state.with_fields(a=moved), 0.3).fields["a"]
        assert both(end)[1] is not None
        assert end.requires_grad


def test_no_cells(plain):
    constants = requiring()
    model = by("compiled", scene(rates, constants)).bind(dtype=F64)
    state = model.start()
    state = state.remove(torch.ones(state.cells, dtype=torch.bool), "removed")
    assert model.step(state, 0.3).cells == 0


def overflows(u, s, p, cell):
    return {"a": p.k * u.a * p.big, "b": 0 * u.b}


@pytest.mark.parametrize("backend", ["compiled", "torch"])
def test_a_cell_that_fails_leaves_the_gradients_of_others(plain, backend):
    """Its derivatives are infinite. It is reported as without gradients."""
    k = torch.tensor(1.0, dtype=F64, requires_grad=True)
    first = torch.tensor(1e-3, dtype=F64, requires_grad=True)
    constants = {"k": k, "big": torch.tensor([1.0, 3e4], dtype=F64)}
    described = by(backend, scene(overflows, constants, initial={"a": first}))
    model = described.bind(2, dtype=F64)
    state = model.step(model.start(), 0.05)
    with torch.no_grad():
        still = model.step(model.start(), 0.05)
    failures = [tf.failures(s)[0].colony_id for s in (state, still) if tf.failures(s)]
    assert failures == [1, 1]
    good = state.select([0])
    found = torch.autograd.grad((good.a * good.volume).sum(), [k, first])
    assert all(bool(x.isfinite()) and float(x) > 0 for x in found)


# --- derivatives that are not those of the operations ---------------------------------------------


class Step(torch.autograd.Function):
    """A step with the slope of a sigmoid, as for training."""

    @staticmethod
    def forward(ctx, x):
        ctx.save_for_backward(x)
        return torch.where(x > 0.6, 1.0, 0.0).to(x.dtype)

    @staticmethod
    def backward(ctx, back):
        s = torch.sigmoid(8 * (ctx.saved_tensors[0] - 0.6))
        return back * 8 * s * (1 - s)


def stepped(u, s, p, cell):
    return {"a": Step.apply(p.k * u.a) - u.a, "b": 0.0 * u.b}


def without_gradients(u, s, p, cell):
    with torch.no_grad():
        held = p.k * u.a
    return {"a": p.k + held - 2 * u.a, "b": 0.0 * u.b}


def detached(u, s, p, cell):
    return {"a": p.k + (p.k * u.a).detach() - 2 * u.a, "b": 0.0 * u.b}


def slope_of(given, segment=2, **options) -> float:
    k = torch.tensor(1.3, dtype=F64, requires_grad=True)
    made = scene(given, {"k": k}, initial={"a": 0.5, "b": 0.0}, **options)
    end = tf.rollout(made.bind(dtype=F64), until=0.6, segment=segment)
    return float(torch.autograd.grad(end.fields["a"].sum(), k)[0])


@pytest.mark.parametrize("given", [stepped, without_gradients])
def test_a_derivative_of_the_users_own_is_taken(given):
    wanted = slope_of(given, method="rk4", steps=64)
    assert abs(wanted) > 0.1
    for backend in ("compiled", "torch"):
        assert slope_of(given, backend=backend, rtol=1e-8) == pytest.approx(wanted, rel=2e-3)


def test_the_derivative_is_not_that_of_the_operations():
    """Of a step it is 0."""
    assert slope_of(lambda u, s, p, c: {"a": torch.where(p.k * u.a > 0.6, 1.0, 0.0) - u.a}) == 0.0


def test_values_do_not_depend_on_whether_gradients_are_off(plain):
    """The solver needs every derivative by species, whatever the user's code holds constant."""
    fast = lambda u, s, p, c: {"a": 1e6 * (p.k - u.a), "b": 0.0 * u.b}
    ends = [
        tf.rollout(scene(x, {"k": 1.3}, backend="compiled").bind(dtype=F64), until=0.4).a
        for x in (fast, torch.no_grad()(fast))
    ]
    assert torch.equal(*ends) and 1.2 < float(ends[0][0]) < 1.3


@pytest.mark.parametrize("backend", ["compiled", "torch"])
def test_tangents_pass_where_gradients_are_off(backend):
    """As torch's own do."""
    found = []
    for given in (without_gradients, lambda u, s, p, c: {"a": p.k + p.k * u.a - 2 * u.a}):
        with forward_mode():
            k = with_tangent(torch.tensor(1.3, dtype=F64), torch.ones((), dtype=F64))
            model = scene(given, {"k": k}, backend=backend, rtol=1e-6).bind(dtype=F64)
            end = tf.rollout(model, until=0.6, segment=None)
            found.append(float(tangent(end.a)[0]))
    assert found[0] == pytest.approx(found[1], rel=1e-6) and abs(found[0]) > 0.1


def test_explain_says_whose_derivative_it_is():
    said = tf.explain(scene(stepped, {"k": 1.3}), seconds=0)
    assert "compiled functions of its equations; gradients by torch, since Step has a deriv" in said
    said = tf.explain(scene(without_gradients, {"k": 1.3}), seconds=0)
    assert "gradients by torch, since gradients are off in parts of it" in said
    assert "gradients by up to 64" in tf.explain(scene(detached, {"k": 1.3}), seconds=0)


def by_energy(u, s, p, cell):
    """The slope of an energy, which torch finds in the rates."""
    with torch.enable_grad():
        at = u.a if u.a.requires_grad else u.a.detach().requires_grad_()
        energy = (p.k * at**2 + 0.1 * at**4).sum()
        (slope,) = torch.autograd.grad(energy, at, create_graph=True)
    return {"a": 1.0 - slope, "b": 0.0 * u.b}


def test_rates_that_take_gradients_themselves():
    plain = lambda u, s, p, c: {"a": 1 - 2 * p.k * u.a - 0.4 * u.a**3}
    wanted = slope_of(plain, rtol=1e-6)
    assert abs(wanted) > 0.05
    assert slope_of(by_energy, rtol=1e-6, segment=None) == pytest.approx(wanted, rel=1e-3)
    assert slope_of(by_energy, method="heun2", steps=8) == pytest.approx(wanted, rel=1e-2)
    with pytest.raises(tf.InputError, match=r"segment=None, or the circuit method='heun2'"):
        slope_of(by_energy)
