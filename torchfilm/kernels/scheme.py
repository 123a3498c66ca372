"""The numbers of the scheme for one-sided contacts, for the kernels and for torch alike.

The scheme is for cells that only push, under any drag. Neighbours move almost alike, though they
may move farther than their own width in a step. So rows are made for all pairs that are near, not
only for those that overlap; a pass moves a cell only so far from what it has of its last move; and
where cells still lie deep, they and their neighbours are solved again. α follows the force:
contacts are as hard as leaves a small mean overlap, at any drag and any pressure.
"""

# In mean radii of a colony: rows are made for pairs nearer than MARGIN, and a pass moves a cell at
# most MARGIN away from its last move, or from that part of it that the cell still has (its point
# nearest to the move: else cells that were fast would coast where growth ends, and 7 % of a channel
# would leave); a pass is repeated where cells lie deeper than TOO_DEEP; contacts are as hard as
# leaves a mean overlap of OVERLAP, of all contacts and of those between cells. (In a channel one
# cell wide most contacts are those with its sides, and light: by the mean of all alone, its cells
# would lie three times as deep in each other.)
MARGIN, TOO_DEEP, OVERLAP = 0.6, 0.2, 0.014
# Where a larger mean overlap is wanted, too deep is DEEPER times that, up to DEEPEST: else passes
# would part in each step what the first one leaves as wanted.
DEEPER, DEEPEST = 10.0, 1.0
# In space two cells side by side at a small angle touch at a point, and may turn about it. That
# brings other parts of them together, which the row of the point does not foresee: a turn of 0.2
# rad makes overlaps of up to 0.12 µm, deeper than TOO_DEEP, and a squeezed cell would turn to and
# fro, pass after pass. So the ends of the stretch along which they lie have rows of their own,
# where they are farther than BEYOND radii from the contact and nearer than MARGIN. In the plane,
# where an end of a cell is at the contact, its two rows foresee such a turn to 0.04 µm. Soft cells
# have no such rows, which would make them stiffer.
BEYOND = 0.5
# In the last of MANY_SUBSTEPS or more, which leave little of the order that was, cells part that
# lie deeper than this share of what is too deep. In every sub-step it would take off growth under
# pressure: at γ = 1,000 a fifth of a colony's volume, where a step takes two or four.
DEEP_AFTER_MANY, MANY_SUBSTEPS = 0.4, 8
# The most that α μ L may be at that overlap, and the least as a share of it; less where the force
# that stops growth, γ Δl, would make more than the share UNMOVED of that overlap. (Drags differ: in
# a full box with γ = 1e6 and μ = 0.01 cells would lie half their width deep in the walls.)
SOFTEST, HARDEST, UNMOVED = 0.04, 1e-4, 0.1
# Contacts are harder where a few are pressed far more than the mean, as where cells are wedged in
# between two walls: such pairs would lie deep after each first pass, and repeated passes would part
# them among others at rest and take off growth, step after step. The eighth root of the mean of the
# eighth powers of the overlaps is at most the share PEAK of what is too deep, or PEAKED times the
# overlap that is wanted: one pair among 400 may lie that deep. In free growth to 10,000 cells
# this asks for nothing. (In closed channels 10 µm wide eight colonies of 1,024 cells have 0.868 of
# the volume of free growth, where they had 0.849, in 1.9 passes a step instead of 2.3.)
PEAK, PEAKED = 0.5, 4.0
# Harder contacts are in vain where cells can neither move nor give way: as in a full chamber after
# a division that leaves ends farther out, for cells give back SHRINK of their growth in a step.
# Forces would be as large as contacts are hard. So contacts are only so hard that their mean force
# is at most MOST_FORCE times what can make it: the greatest force that stops growth, γ Δl, and the
# forces that all moves need together, as a row of cells passes all of them on to a wall. In free
# growth and open channels this changes nothing. (In boxes 20 µm wide the force on the walls was up
# to seven times that of the full box while they filled; so, it is about twice that.)
MOST_FORCE = 3.0
# A pressed cell may lose this part of its growth in a step. Where a cell may lose none, overlaps in
# closed chambers are twice as deep.
SHRINK = 0.05
# It becomes shorter than it once was by no more than this share of its whole length: else, in a
# full chamber, some cells would grow for ever at the cost of others.
COMPRESSION = 0.05
# The first pass is solved again where α turns out to be less than this share of what it was.
LAG = 0.5
# Contacts of a pass whose solve has not converged are taken softer by this factor until it does, at
# most by MOST_SOFTER, and then harder again, each solve from the last.
SOFTER, MOST_SOFTER = 8.0, 8.0**5
# A repeated pass moves the cells that lie deep and those up to HOPS contacts away, the next one
# those up to twice as far, and so on up to MOST_HOPS: the same few, among others at rest, may find
# no room. After repeated pass LONG_MOVES a pass moves cells only SHORTER as far. Rows do not
# foresee how far a turn carries an end aside; of two neighbours that have to part, now the one and
# now the other would lie deep. (In free growth to 10,000 cells, with HOPS and long moves alone and
# 8 passes at most, one step in 27 left a pair deeper than 0.3 µm; so, none did in 8 colonies.)
HOPS, MOST_HOPS = 3, 9
LONG_MOVES, SHORTER = 4, 1 / 3
# In each pass after LONG_MOVES the drag of moves and turns is SLOWER times that of the pass before,
# that of lengths is not. Where a chamber of short cells is full, moves of several µm cost less than
# growth that is taken back: all would be cut short, none would have made room, and growth would go
# on until cells lie in each other. The drag is at most SLOWEST times higher where contacts are
# softest, and as much more as they are harder: else cells that lie deep would not part.
SLOWER, SLOWEST = 4.0, 12.0
# No cell turns by more than this in one pass, rad. Bilateral contacts have the same bound.
MAX_TURN = 0.5
# Relative error of the contact forces that a solve leaves, root mean square; passes at most.
TOLERANCE, PASSES = 0.07, 24
# The share of a Newton round's residual that CG leaves: in the first EASY_ROUNDS, which are enough
# for most solves, and in those after. Longer solves are those of contacts that hardly hold each
# other in place. With the first share they would stop at up to four times the tolerance: local
# residuals would hide how far slow moves are from their end.
FORCING, FORCING_LATE, EASY_ROUNDS = 0.2, 0.1, 5
# The share of a round's slope that the line search leaves; rounds a solve, and looks a line search,
# at most.
LEVEL = 0.1
MOST_ROUNDS, MOST_LOOKS = 200, 30
# CG ends where the curvature along its direction is this share of rz or less. They are about equal,
# until rounding leaves nothing of the curvature; a step of rz over it would not be a number.
FLAT = 1e-30
# A block's diagonal is raised by this share before it is inverted, in float64.
RAISED = 1e-9
# A length nearer to its bound than this, relative to the bound and the step, is at it.
ROUNDING = 1e-6
# Lengths that stop at their bound step alone in the round after one that went less than this share.
CREEP = 0.5
# By how much the reach of cells in a periodic space is enlarged, so that rounding loses no pair
# that touches exactly.
ENLARGED = 1e-5
# Sub-steps at most.
MOST_SUBSTEPS = 1000
# A colony whose contacts do not hold has more than BURIED of its cells (of MANY, if it has fewer)
# deep in others for LONG steps. Cells that start in a heap part within a few steps.
BURIED, MANY, LONG = 0.1, 50, 20
# The status of a solve or of a step; `physics.problem` has the words.
CONVERGED, ITERATION_LIMIT, NOT_FINITE, TOO_FAST, BAD_DRAG, COLLAPSED = range(6)
TOO_STICKY, BAD_LENGTH, TOO_LONG = 6, 7, 8
