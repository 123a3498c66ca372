"""Measures of a state: overlaps, forces, pressure; place, size and shape of colonies; how strains
are mixed; quantities in space and between neighbours; growth and motion since an earlier state."""

from torchfilm.colony_edge import Outline
from torchfilm.film_shape import Film
from torchfilm.measure.change import displacement, growth_rates
from torchfilm.measure.forces import Overlap, WallForces, overlaps, pressure, wall_forces
from torchfilm.measure.hull import Hull, hull
from torchfilm.measure.images import image, labels, medium
from torchfilm.measure.mixing import alike_neighbours, clusters, heterozygosity, strains
from torchfilm.measure.shape import (
    aspect_ratio,
    below_edge,
    below_top,
    colony_centre,
    colony_radius,
    depth,
    film,
    nematic_order,
    outline,
    tilt,
)
from torchfilm.measure.space import correlation, moran, neighbours, profile

__all__ = [
    "Film",
    "Hull",
    "Outline",
    "Overlap",
    "WallForces",
    "alike_neighbours",
    "aspect_ratio",
    "below_edge",
    "below_top",
    "clusters",
    "colony_centre",
    "colony_radius",
    "correlation",
    "depth",
    "displacement",
    "film",
    "growth_rates",
    "heterozygosity",
    "hull",
    "image",
    "labels",
    "medium",
    "moran",
    "neighbours",
    "nematic_order",
    "outline",
    "overlaps",
    "pressure",
    "profile",
    "strains",
    "tilt",
    "wall_forces",
]
