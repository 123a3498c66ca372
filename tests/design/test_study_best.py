"""Which design of a study is the best."""

from __future__ import annotations

import numpy as np

from design import Study
from design.entries import Entry


def entry(point: float, loss: float, replicates: int, size: float = 1.0) -> Entry:
    return Entry(
        points=np.array([[point]]), loss=np.array([loss]), losses=np.full((1, replicates), loss),
        cells=np.ones((1, replicates), int), reasons={}, size=size, seconds=0.0, values=[{}],
        streams=tuple(range(replicates)),
    )  # fmt: skip


def test_only_designs_of_full_size_with_all_replicates_are_compared():
    entries = [entry(0.1, 0.0, 1), entry(0.2, 0.0, 4, size=0.5), entry(0.3, 1.0, 4)]
    study = Study({}, ("make",), (0, 1, 2, 3), entries=entries)
    point, loss, losses = study.best()
    assert (point.tolist(), loss, losses.tolist()) == ([0.3], 1.0, [1.0] * 4)
