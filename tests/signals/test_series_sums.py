"""The sums of a series of mixings: their backward pass against torch's graph of every term."""

from __future__ import annotations

import gc

import numpy as np
import pytest
import torch

from torchfilm.signals import compiled_sums, series_sums
from torchfilm.signals.mixing import Mixing
from torchfilm.signals.series_sums import sums
from torchfilm.signals.transport_series import poisson
from torchfilm.tools.tangents import both, forward_mode, with_tangent

F64 = torch.float64
SHAPE = (4, 3, 2)


def made(colonies=2, one_mixing=False, gain=True, dims=(1, 2, 3)):
    """Values of a mixing of so many colonies, all of which require gradients, and weights."""
    draw = torch.Generator().manual_seed(0)
    rand = lambda b: torch.rand(b, *SHAPE, generator=draw, dtype=F64).requires_grad_()
    own = 1 if one_mixing else colonies
    stay, u = rand(own), rand(colonies)
    sides = [(d, rand(own), rand(1)) for d in dims]  # and one that all colonies share
    mean = np.linspace(0.4, 1.7, colonies)
    weights, tails = (torch.as_tensor(x) for x in poisson(mean, 1e-9))
    return Mixing(stay, tuple(sides)), rand(own) if gain else None, (weights, tails), u


def leaves(mixing, gain, _rows, u):
    each = (u, gain, mixing.stay, *(x for _, *both in mixing.gains for x in both))
    return [x for x in each if x is not None]


def loss(found) -> torch.Tensor:
    return sum((x * torch.linspace(0.1, 2.0, x.numel(), dtype=F64).view_as(x)).sum() for x in found)


FORMS = [{}, {"gain": False}, {"one_mixing": True}, {"colonies": 1}, {"dims": (2,)}, {"dims": ()}]


@pytest.mark.parametrize("way", [series_sums.KEPT, 0, "kernels"])
@pytest.mark.parametrize("form", FORMS)
def test_gradients_are_those_of_every_term(form, way, monkeypatch):
    by_kernels = way == "kernels"
    if not by_kernels:
        monkeypatch.setattr(series_sums, "KEPT", way)
    given = made(**form)
    ours, theirs = sums(*given, compiled=by_kernels), series_sums._by_terms(*given)
    assert all(torch.allclose(a, b, rtol=1e-14) for a, b in zip(ours, theirs, strict=True))
    assert by_kernels or all(torch.equal(a, b) for a, b in zip(ours, theirs, strict=True))
    assert ours[0].grad_fn is not None and "_Sums" in type(ours[0].grad_fn).__name__
    own = leaves(*given)
    found, expected = (torch.autograd.grad(loss(x), own) for x in (ours, theirs))
    for a, b in zip(found, expected, strict=True):
        assert a.shape == b.shape and float(a.abs().max()) > 0
        assert torch.allclose(a, b, rtol=1e-12)


@pytest.mark.parametrize("compiled", [False, True])
def test_one_of_several_requires_a_gradient(compiled):
    for chosen in range(9):
        given = made()
        own = leaves(*given)
        for k, x in enumerate(own):
            x.requires_grad_(k == chosen)
        found = torch.autograd.grad(loss(sums(*given, compiled=compiled)), own[chosen])[0]
        expected = torch.autograd.grad(loss(series_sums._by_terms(*given)), own[chosen])[0]
        assert torch.allclose(found, expected, rtol=1e-12)
    assert len(own) == 9
    own[chosen].requires_grad_(False)
    assert not sums(*given)[0].requires_grad


def test_the_end_alone_and_the_mean_alone():
    given = made()
    own = leaves(*given)
    for part in (0, 1):
        found = torch.autograd.grad(loss([sums(*given)[part]]), own)
        expected = torch.autograd.grad(loss([series_sums._by_terms(*given)[part]]), own)
        assert all(torch.allclose(a, b, rtol=1e-12) for a, b in zip(found, expected, strict=True))


@pytest.mark.parametrize("compiled", [False, True])
def test_several_backward_passes_and_second_derivatives(compiled):
    given = made()
    own = leaves(*given)
    found = sums(*given, compiled=compiled)
    first, again = (torch.autograd.grad(loss(found), own, retain_graph=True) for _ in range(2))
    assert all(torch.equal(a, b) for a, b in zip(first, again, strict=True))
    bent = []
    for x in (found, series_sums._by_terms(*given)):
        slopes = torch.autograd.grad(loss(x), own, create_graph=True)
        bent.append(torch.autograd.grad(sum((s * s).sum() for s in slopes), own))
    assert all(torch.allclose(a, b, rtol=1e-10) for a, b in zip(*bent, strict=True))


def test_terms_backwards():
    mixing, gain, _, u = made()
    for kept in (0, series_sums.KEPT):
        for count in (1, 2, 3, 4, 5, 9, 10, 11, 37):
            with pytest.MonkeyPatch.context() as patch, torch.no_grad():
                patch.setattr(series_sums, "KEPT", kept)
                found = list(series_sums._backwards(mixing, gain, u, count))
                expected = [u]
                while len(expected) < count:
                    expected.append(mixing.of(expected[-1]) + gain)
            assert len(found) == count
            assert all(torch.equal(a, b) for a, b in zip(found[::-1], expected, strict=True))


@pytest.mark.usefixtures("new_objects")
def test_few_terms_are_held_at_once():
    mixing, _, _, u = made()
    kept: list[int] = []
    with pytest.MonkeyPatch.context() as patch, torch.no_grad():
        patch.setattr(series_sums, "KEPT", 0)
        for k, term in enumerate(series_sums._backwards(mixing, None, u, 400)):
            del term
            if k % 19 == 0:  # at all places of a block, which has 21 terms
                kept.append(
                    sum(type(x) is torch.Tensor and x.shape == u.shape for x in gc.get_objects())
                )
    assert k == 399 and max(kept) - min(kept) < 60


def test_the_transposed_mixing():
    for dims in ((1, 2, 3), (2,), ()):
        mixing = made(dims=dims)[0]
        a, b = torch.rand(2, 2, *SHAPE, dtype=F64)
        one, other = (a * mixing.of(b)).sum(), (mixing.transposed().of(a) * b).sum()
        assert torch.allclose(one, other, rtol=1e-13)
        back = mixing.transposed().transposed()
        assert torch.equal(back.of(a), mixing.of(a))


def test_many_directions_at_once():
    """As `jacobian` takes them where it is vectorized."""
    given = made(colonies=1)
    (end, _), own = sums(*given), leaves(*given)
    directions = torch.eye(end.numel(), dtype=F64).view(-1, *end.shape)[:5]
    many = torch.autograd.grad(end, own, directions, is_grads_batched=True, retain_graph=True)
    for k, direction in enumerate(directions):
        one = torch.autograd.grad(end, own, direction, retain_graph=True)
        assert all(torch.allclose(a[k], b) for a, b in zip(many, one, strict=True))


def test_by_kernels_a_colony_has_the_same_bits_in_any_company():
    mixing, gain, rows, u = made(colonies=3)
    whole = sums(mixing, gain, rows, u, compiled=True)
    slopes = torch.autograd.grad(loss(whole), (u, gain, mixing.stay))
    for k in range(3):
        part = lambda x, k=k: x[k : k + 1] if x.shape[0] > 1 else x
        gains = tuple((d, part(a), part(b)) for d, a, b in mixing.gains)
        alone = Mixing(part(mixing.stay), gains)
        one = sums(alone, part(gain), [part(x.T).T for x in rows], part(u), compiled=True)
        assert all(torch.equal(a, b[k : k + 1]) for a, b in zip(one, whole, strict=True))
        weighted = sum(
            (x * torch.linspace(0.1, 2.0, 3 * x.numel(), dtype=F64).view(3, *x.shape[1:])[k]).sum()
            for x in one
        )
        found = torch.autograd.grad(weighted, (u, gain, mixing.stay))
        assert all(torch.equal(a[k], b[k]) for a, b in zip(found, slopes, strict=True))


def test_one_term_alone():
    mixing, gain, _, u = made()
    rows = torch.tensor([[[0.3, 0.7]]], dtype=F64)
    for compiled in (False, True):
        (end,) = sums(mixing, gain, rows, u, compiled=compiled)
        slope, *none = torch.autograd.grad(end.sum(), (u, gain, mixing.stay), allow_unused=True)
        assert torch.equal(slope, rows[0, 0].reshape(2, 1, 1, 1).expand_as(u))
        assert all(x is None or not bool(x.any()) for x in none)


@pytest.mark.parametrize("held", [1, 2, 3, 4, 7, 30])
def test_terms_that_are_held_at_once_change_no_bit(held, monkeypatch):
    """One long series sent all colonies of a batch to torch, which adds up in another order."""
    slopes = []
    for some in (None, held):
        mixing, gain, rows, u = made()
        if some is not None:
            monkeypatch.setattr(compiled_sums, "MOST_HELD", 0)
            monkeypatch.setattr(compiled_sums, "_held", lambda terms, size: held)
        ends = sums(mixing, gain, rows, u, compiled=True)
        values = [u, gain, *mixing.numbers]
        slopes.append(torch.autograd.grad(sum((x**2).sum() for x in ends), values))
    assert all(torch.equal(a, b) for a, b in zip(*slopes, strict=True))


def test_a_long_series_holds_the_root_of_its_terms(monkeypatch):
    assert compiled_sums._held(1000, 10) == 1000 and compiled_sums._held(0, 10) == 1
    monkeypatch.setattr(compiled_sums, "MOST_HELD", 10)
    assert compiled_sums._held(1000, 10) == 32


def test_a_gradient_that_carries_a_tangent(monkeypatch):
    """Forward over reverse: kernels dropped the tangent of what came back."""
    found = []
    for compiled in (True, False):
        mixing, gain, rows, u = made()
        factor = torch.tensor(2.0, dtype=F64)
        with forward_mode():
            ends = sums(mixing, gain, rows, u, compiled=compiled)
            moved = with_tangent(factor, torch.ones_like(factor))
            slopes = torch.autograd.grad(moved * sum((x**2).sum() for x in ends), [u, gain])
            found.append([both(x) for x in slopes])
    for (ours, turned), (theirs, torchs) in zip(*found, strict=True):
        assert torch.allclose(ours, theirs, rtol=1e-12) and turned is not None
        assert torch.allclose(turned, torchs, rtol=1e-12) and bool(turned.any())


def test_kernels_are_used_where_they_may_be(monkeypatch):
    """And torch's operations in forward mode, and for second derivatives."""
    used: list[str] = []
    for name in ("add_up", "pull"):
        own = getattr(compiled_sums, name)
        note = lambda *given, own=own, name=name: (used.append(name), own(*given))[1]
        monkeypatch.setattr(compiled_sums, name, note)
    given = made()
    ends = sums(*given, compiled=True)
    torch.autograd.grad(loss(ends), leaves(*given))
    assert used == ["add_up", "pull"]
    (slope,) = torch.autograd.grad(
        loss(x**2 for x in sums(*given, compiled=True)), given[-1], create_graph=True
    )
    with forward_mode():
        sums(*given, compiled=True)
    sums(*given)
    assert used == ["add_up", "pull", "add_up"] and slope.requires_grad
