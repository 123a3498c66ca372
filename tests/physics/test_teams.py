"""A team of threads solves a large colony to the same bits as one thread."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch

import torchfilm as tf
from torchfilm.kernels import team
from torchfilm.kernels.compiling import for_python
from torchfilm.physics import compiled

AGAR = [tf.Plane(z=-0.5, facing="+z", stiffness=16.0), tf.Plane(z=0.5, facing="-z")]
SCENES = {
    "free growth": (6.6, torch.float32, {"dim": 2}),
    "pressed around a post": (
        9.0,
        torch.float32,
        {"dim": 2, "length_drag": 10.0, "walls": [tf.Sphere((0.0, 3.0), 2.0, inside=False)]},
    ),
    "soft walls in space": (6.6, torch.float64, {"dim": 3, "walls": AGAR}),
}


@pytest.mark.slow
@pytest.mark.skipif(not team.AVAILABLE, reason="threads cannot wait for each other here")
@pytest.mark.parametrize("name", SCENES)
def test_a_team_changes_no_bit(name, monkeypatch):
    """A colony of some 300 cells, so that loops have several pieces, and a small one."""
    until, dtype, given = SCENES[name]
    scene = tf.Scene(
        tf.Growth(rate=tf.PerColony([1.0, 0.5])),
        tf.Division(length=tf.Uniform(2.5, 3.5)),
        tf.Mechanics(**given),
        dt=0.05,
    )
    teams, by_team = [], compiled._call_by_team
    monkeypatch.setattr(compiled, "_call_by_team", lambda *a: (teams.append(a[1]), by_team(*a))[1])
    monkeypatch.setattr(compiled, "CELLS_A_THREAD", 32)
    before, runs = torch.get_num_threads(), []
    try:
        for threads in (1, 2, 3, 8):
            torch.set_num_threads(threads)
            *_, last = tf.simulate(scene, until=until, colonies=2, seed=3, dtype=dtype)
            runs.append(last)
    finally:
        torch.set_num_threads(before)
    assert runs[0].counts.max() > 4 * team.BLOCK and set(teams) >= {2, 3, 8}
    for other in runs[1:]:
        for field in ("position", "axis", "length", "displacement", "contact_alpha"):
            assert torch.equal(getattr(runs[0], field), getattr(other, field)), field


@pytest.mark.slow
@pytest.mark.skipif(not team.AVAILABLE, reason="threads cannot wait for each other here")
def test_a_team_reads_no_memory_that_was_given_back():
    """With this setting it is overwritten; then kernels are compiled again."""
    found = subprocess.run(
        [sys.executable, "-m", "pytest", "-q", "-n", "0", "-k", "bit and post", __file__],
        env={**os.environ, "TORCHFILM_OVERWRITES_MEMORY": "1"},
        capture_output=True,
        text=True,
        cwd=Path(__file__).parents[2],
    )
    assert found.returncode == 0, found.stdout + found.stderr


def test_pieces_are_whole_blocks_and_make_up_all_cells():
    pieces_for, range_of = for_python(team.pieces_for), for_python(team.range_of)
    for n in (1, 64, 65, 1000, 4097):
        board = team.new_board(3, 1, 0)
        pieces = pieces_for(board, n)
        ranges = [range_of(k, pieces, n) for k in range(pieces)]
        assert ranges[0][0] == 0 and ranges[-1][1] == n
        assert all(a < b for a, b in ranges)
        assert all(ranges[k][1] == ranges[k + 1][0] for k in range(pieces - 1))
        assert all(a % team.BLOCK == 0 for a, _ in ranges)


def test_each_piece_is_taken_once_by_the_leader_or_by_another():
    board, take = team.new_board(2, 1, 0), for_python(team.take)
    assert take(board, True) == -1  # nothing is offered yet
    board[team.OFFER] = 5
    taken = [take(board, leads) for leads in (True, False, False, True, False)]
    assert taken == [0, 4, 3, 1, 2]
    assert take(board, True) == -1
    board[team.OFFER] = team.OVER
    assert take(board, False) == -1
