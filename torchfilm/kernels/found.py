"""Contacts of a colony: those that are found, those after a move, and those of deep cells.

What is found: near pairs (first, second), and of the contacts the place among these, the closest
points and the gap, µm: see `contacts.near_contacts`.
"""

from __future__ import annotations

import numpy as np

from torchfilm.kernels.compiling import lean
from torchfilm.kernels.contact_pieces import shared_near_contacts, shares
from torchfilm.kernels.contacts import deepest_of, near_contacts, room_for_contacts
from torchfilm.kernels.memory import room, zeros
from torchfilm.kernels.moves import approach
from torchfilm.kernels.neighbours import near_pairs, near_pairs_of
from torchfilm.kernels.rows import HARD

# A search of all pairs takes no longer than one of the pairs of so many of the cells.
MOST_SOME = 0.3


@lean
def deep_cells(memory, found, rows, walls, deep, n, hops):
    """Numbers of those of n cells that lie deeper than `deep` in others, of those up to `hops`
    contacts away, and of those so deep in a hard wall; −1 for the others; how many; and their
    contacts, as others make no row that counts. n is 0: all contacts."""
    first, second, keep, _, gap = found
    _, gaps, one, _, soft = rows
    if n == 0:
        return room(memory, (0,), np.int32), 0, found
    mark = zeros(memory, (n,), np.int64)
    for k in range(keep.shape[0]):
        if gap[k] < -deep:
            mark[first[keep[k]]] = mark[second[keep[k]]] = 1
    for hop in range(1, hops + 1):
        for k in range(keep.shape[0]):
            i, j = first[keep[k]], second[keep[k]]
            if gap[k] < 0.1 * deep:
                if mark[i] == hop and mark[j] == 0:
                    mark[j] = hop + 1
                elif mark[j] == hop and mark[i] == 0:
                    mark[i] = hop + 1
    numbers, count = room(memory, (n,), np.int32), 0
    for i in range(n):
        numbers[i] = count if mark[i] > 0 else -1
        count += mark[i] > 0
    for r in range(walls):
        if soft[r] == HARD and gaps[r] < -deep and numbers[one[r]] < 0:
            numbers[one[r]] = count
            count += 1
    return numbers, count, _found_by(memory, numbers, found)


@lean
def _found_by(memory, numbers, found):
    """The contacts `found` of numbered cells."""
    first, second, keep, points, gap = found
    m, new = keep.shape[0], 0
    some = room_for_contacts(memory, m)
    for k in range(m):
        some[0][new], some[2][new] = keep[k], gap[k]
        some[1][new, 0], some[1][new, 1] = points[k, 0], points[k, 1]
        new += numbers[first[keep[k]]] >= 0 or numbers[second[keep[k]]] >= 0
    return first, second, some[0][:new], some[1][:new], some[2][:new]


@lean
def found_contacts(memory, team, x, axis, half, radius, periods, margin, dof):
    """Near pairs (first, second), and the contacts among them: see `near_contacts`."""
    pairs = near_pairs(memory, x, axis, half, radius, periods, margin, dof)
    return _contacts_among(memory, team, x, axis, half, radius, periods, margin, pairs, dof)


@lean
def _contacts_among(memory, team, x, axis, half, radius, periods, margin, pairs, dof):
    """The contacts among pairs, which are the first two of `pairs`."""
    first, second = pairs[0], pairs[1]
    if shares(team, x.shape[0], first.shape[0]):
        return shared_near_contacts(
            memory, team, x, axis, half, radius, periods, first, second, margin, dof
        )
    keep, points, gap = near_contacts(
        memory, x, axis, half, radius, periods, first, second, margin, dof
    )
    return first, second, keep, points, gap


@lean
def found_after(memory, team, x, axis, radius, periods, margin, deep, found, arrays, dof):
    """The contacts after a move, and whether one of them is deeper than `deep`. Where none is, they
    may be those before it, `found`. Puts the half lengths after it into the arrays."""
    length, _, half, _, _, _, y, _, _ = arrays
    for i in range(half.shape[0]):
        half[i] = 0.5 * length[i]
    if deepest_of(memory, x, axis, half, radius, periods, found, dof) >= -deep:
        # others were farther than margin: of those that met, one has come half of the way
        together, own = approach(memory, x, length, radius, periods, y, dof)
        some, count = room(memory, own.shape, np.uint8), 0
        for i in range(own.shape[0]):
            some[i] = own[i] > 0.5 * (margin + deep - together)
            count += some[i]
        if count == 0:
            return found, False
        if count <= MOST_SOME * own.shape[0]:
            pairs = near_pairs_of(memory, x, axis, half, radius, periods, 0.0, some, dof)
            met = _contacts_among(memory, team, x, axis, half, radius, periods, 0.0, pairs, dof)
            if _deepest(met[4]) >= -deep:
                return found, False
    found = found_contacts(memory, team, x, axis, half, radius, periods, margin, dof)
    return found, _deepest(found[4]) < -deep


@lean
def _deepest(gap):
    deepest = 0.0
    for k in range(gap.shape[0]):
        deepest = min(deepest, gap[k])
    return deepest
