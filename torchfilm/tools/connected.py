"""Connected components of a graph."""

from __future__ import annotations

import torch
from torch import Tensor


def components(first: Tensor, second: Tensor, count: int) -> Tensor:
    """The number of the component of each of `count` nodes, (count,) int64, from pairs of nodes
    that hang together, each (P,) int64."""
    # imported where it is used: it takes longer to load than torchfilm itself
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    pairs = (torch.ones(len(first)).numpy(), (first.cpu().numpy(), second.cpu().numpy()))
    _, of = connected_components(coo_array(pairs, shape=(count, count)), directed=False)
    return torch.from_numpy(of.astype("int64")).to(first.device)
