"""The numbers of the scheme for bilateral contacts, for the kernels and for torch alike.

The scheme is the paper's least squares over the overlapping pairs, by projected Newton and
conjugate gradients. What a pass leaves too deep is solved again among all others at rest.
"""

# What a pass leaves overlapping by more than DEEP radii is solved again in the next one, among all
# the others at rest. It is a few cells in a hundred, which slip or turn. For the others one solve
# already reaches the overlap that the penalty allows, and solving for them again takes twice the
# time.
DEEP = 0.2
# The overlap, µm, that colonies which take sub-steps are solved to: their steps are coarse.
CLOSE = 0.02
COARSE_PASSES = 6
# Tolerance of the solve at the default penalty α γ. Overlaps hardly depend on it, growth under
# pressure does: of three cells in a row the middle one grows 14 % too little at 0.05, and 1.7 % at
# 0.005, which takes a colony of 2,000 cells a tenth more time.
# The harder contacts are, the farther from rest is what moves with none of them at the same
# residual: a tolerance that falls as (α γ)^¼ is enough from 0.1 down to 1e-6, and one
# that falls faster is out of reach of float32.
PENALTY, TOLERANCE = 0.1, 0.005
# Distance of two surfaces, in radii, within which a later pass keeps them at least as far apart as
# they are.
NEAR = 0.1
# Pairs nearer than this share of the sum of their radii are looked at. No point of a line is nearer
# than the closest one, except for rounding, of which this is many times more.
CANDIDATE = 1e-3
# The number of points along a move where a sphere met from outside is looked for. Other walls have
# all cells on one side, so the end of the move is enough.
POINTS_ON_MOVE = 8
# The share of its target that CG must reach. It is below 1, since lengths that meet their bound
# undo part of the progress, and the true residual differs by rounding from the recurred one.
# Measured: 0.5 costs as much as 0.8, in fewer rounds of more iterations, and leaves a smaller
# residual.
FINISH = 0.5
# A solve is limited by its CG iterations, and each round takes at least one. This many rounds is
# the last resort.
NEWTON_LIMIT = 200
# A round has stalled if it leaves more than this share of the residual. Then what rounding may
# leave limits the residual: ROUNDING_UNITS in the last place of the absolute forces on a cell.
STALLED, ROUNDING_UNITS = 0.9, 2.0
# A step is kept if its upward slope at the end is at most STEEP of the slope at the start.
STEEP = 0.5
# With lengths stopped at their bounds, a step must keep DOWNHILL of its slope, or it is halved. A
# step is shortened at most MAX_HALVINGS times.
DOWNHILL, MAX_HALVINGS = 0.01, 30
# A step that just reaches a bound is longer by this share, so that the length is stopped at the
# bound and not just before it.
BEYOND_BOUND = 1e-5
# Each cell's block is raised by this many units in the last place of its diagonal before inversion.
BLOCK_FLOOR = 64
