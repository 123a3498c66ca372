"""Small vector algebra, components first: an array of K vectors in d dimensions is (d, K).

With components first, every operation is a plain pass over contiguous memory. It also fixes the
order of the two or three additions of a dot product, so results do not depend on the number of
vectors in the array.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from torchfilm.tools.tangents import both


def dot(u: Tensor, v: Tensor) -> Tensor:
    """u · v for (d, K), (d, K) -> (K,)."""
    out = u[0] * v[0]
    for k in range(1, u.shape[0]):
        out = out + u[k] * v[k]
    return out


def cross(u: Tensor, v: Tensor) -> Tensor:
    """u × v: (3, K) in 3-D; in 2-D the component out of the plane, (1, K)."""
    if u.shape[0] == 2:
        return (u[0] * v[1] - u[1] * v[0]).unsqueeze(0)
    return torch.stack(
        [u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]]
    )


def perpendicular(u: Tensor) -> Tensor:
    """A unit vector perpendicular to unit u, (d, K).

    In 2-D it is the left-hand normal. In 3-D it is built from the axis with the least component of
    u.
    """
    if u.shape[0] == 2:
        return torch.stack([-u[1], u[0]])
    x, y, z = u.detach().abs().unbind(0)
    on_x = (x <= y) & (x <= z)
    on_y = ~on_x & (y <= z)
    w = cross(u, torch.stack([on_x, on_y, ~(on_x | on_y)]).to(u.dtype))
    return w / safe_norm(w)


def safe_norm(u: Tensor, eps: float = 1e-30) -> Tensor:
    """|u| for (d, K) -> (K,), with gradient 0 instead of NaN where u = 0."""
    return safe_sqrt(dot(u, u), eps)


def safe_sqrt(x: Tensor, eps: float = 1e-30) -> Tensor:
    """√x, and 0 with gradient 0 where x ≤ eps."""
    if not (torch.is_grad_enabled() and x.requires_grad):
        return torch.where(x > eps, x.sqrt(), 0.0)
    positive = x > eps
    return torch.where(
        positive, torch.where(positive, x, torch.ones_like(x)).sqrt(), torch.zeros_like(x)
    )


def nearest_root(x: Tensor) -> Tensor:
    """√x to the nearest number, as kernels have it; torch's own may be the next one."""
    found = x.sqrt()
    if x.device.type != "cpu":
        return found
    plain, nearest = both(found)[0], torch.from_numpy(np.sqrt(both(x)[0].numpy()))
    return found + torch.where(nearest == plain, 0.0, nearest - plain)


def nearest_to(point: Tensor, end: Tensor) -> Tensor:
    """The point between 0 and `end` that is nearest to `point`, (d, K) each."""
    along, square = dot(end, point), dot(end, end)
    return end * (along / torch.where(square > 0, square, 1.0)).clamp(0.0, 1.0)
