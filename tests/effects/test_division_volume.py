"""`Division(conserves="volume")`: daughters have the volume of their parent, and touch."""

from __future__ import annotations

import math

import pytest
import torch

import torchfilm as tf

F64 = torch.float64


def divided(dim: int, fraction: float, by_torch: bool, monkeypatch, **given):
    """A cell and its two daughters."""
    pytest.importorskip("numba")  # kernels divide where it has been loaded
    if by_torch:
        monkeypatch.setattr("torchfilm.effects.division.can_divide", lambda *_: False)
    place, axis = [1.0, 2.0, 0.0][:dim], [0.6, 0.8, 0.0][:dim]
    cell = tf.Cells([place], [axis], length=[3.0], radius=[0.4])
    division = tf.Division(fraction=fraction, axis_noise=0.0, **given)
    scene = tf.Scene(division, founders=cell, dim=dim)
    model = scene.bind(dtype=F64)
    first = model.start()
    return first, model.step(first.with_fields(divide_flag=torch.tensor([True])), 0.1)


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("fraction", [0.5, 0.3])
@pytest.mark.parametrize("by_torch", [False, True])
def test_daughters_have_the_volume_and_touch(dim, fraction, by_torch, monkeypatch):
    parent, two = divided(dim, fraction, by_torch, monkeypatch, conserves="volume")
    assert float(two.volume.sum()) == pytest.approx(float(parent.volume[0]), rel=1e-14)
    assert float(two.volume[0] / parent.volume[0]) == pytest.approx(fraction, rel=1e-13)
    first, second = two.length.tolist()
    # touching: their centres are half of each centreline and two radii apart
    apart = float((two.position[1] - two.position[0]).norm())
    assert apart == pytest.approx(0.5 * (first + second) + 0.8, rel=1e-13)
    # each outer end is a third of a radius beyond that of the parent
    along = (two.position - parent.position) @ parent.axis[0].double()
    ends = float(along[0]) - 0.5 * first, float(along[1]) + 0.5 * second
    assert ends == pytest.approx((-1.5 - 0.4 / 3, 1.5 + 0.4 / 3), rel=1e-13)


@pytest.mark.parametrize("by_torch", [False, True])
def test_by_default_the_length_is_conserved(by_torch, monkeypatch):
    parent, two = divided(2, 0.5, by_torch, monkeypatch)
    assert two.length.tolist() == pytest.approx([1.1, 1.1], rel=1e-14)
    lost = float(parent.volume[0] - two.volume.sum())
    assert lost == pytest.approx(2 / 3 * math.pi * 0.4**3, rel=1e-12)


def test_a_free_colony_of_any_division_length_grows_as_its_law():
    for low, high in ((1.8, 2.2), (5.0, 7.0)):
        division = tf.Division(length=tf.Uniform(low, high), conserves="volume")
        scene = tf.Scene(tf.Growth(rate=1.0), division, tf.Mechanics(dim=2))
        first = scene.bind().start()
        *_, last = tf.simulate(scene, until=5.0)
        grown = float(last.volume.sum() / first.volume.sum())
        assert grown == pytest.approx(math.exp(5.0), rel=5e-3)
        assert float(tf.measure.overlaps(last).mean) < 0.02


def test_another_word_is_refused():
    with pytest.raises(tf.InputError, match=r"Division.conserves = 'area'.*'length', 'volume'"):
        tf.Division(length=4.0, conserves="area")


@pytest.mark.parametrize("by_torch", [False, True])
def test_a_cell_may_be_as_short_as_its_volume_allows(by_torch, monkeypatch):
    """Two balls of radius 0.4 hold as much as a cell of 4/3 · 0.4 µm: far less than two radii."""
    pytest.importorskip("numba")  # kernels divide where it has been loaded
    if by_torch:
        monkeypatch.setattr("torchfilm.effects.division.knows_due", lambda *_: False)
    division = tf.Division(conserves="volume", axis_noise=0.0)
    for length, status in ((0.54, 0), (0.52, 1)):
        cell = tf.Cells([[0.0, 0.0]], [[1.0, 0.0]], length=[length], radius=[0.4])
        model = tf.Scene(division, founders=cell).bind(dtype=F64)
        state = model.step(model.start().with_fields(divide_flag=torch.tensor([True])), 0.1)
        report = state.reports.get("division")
        assert (0 if report is None else int(report.status)) == status
        assert state.cells == 2 - status
