"""The effects that torchfilm has. They never import each other and meet through named fields
only."""

from torchfilm.effects.circuit import Circuit
from torchfilm.effects.division import Division
from torchfilm.effects.erosion import Erosion
from torchfilm.effects.growth import Growth
from torchfilm.effects.lysis import Lysis
from torchfilm.effects.mechanics import Mechanics
from torchfilm.effects.medium import Medium
from torchfilm.effects.medium_reactions import MediumReactions
from torchfilm.effects.motility import Motility
from torchfilm.effects.nutrition import Monod
from torchfilm.effects.removal import Removal
from torchfilm.effects.rules import Rules
from torchfilm.effects.sloughing import Sloughing

# In the order of a step, by the names that `explain` uses.
KNOWN = {
    "rules": Rules,
    "nutrition": Monod,
    "motility": Motility,
    "growth": Growth,
    "mechanics": Mechanics,
    "circuit": Circuit,
    "medium reactions": MediumReactions,
    "transport": Medium,
    "lysis": Lysis,
    "division": Division,
    "removal": Removal,
    "erosion": Erosion,
    "sloughing": Sloughing,
}
