"""The text of the methods with equal steps, `integrators`, cell by cell.

The order of operations is that of torchdiffeq, and so is the type of numbers: that of the state.
"""

from __future__ import annotations

from torchfilm.circuits.emission import as_tuple

# By method: where rates are taken after a, those at u, and the change of u; h is the step. Terms
# with a factor of 0 stay: they carry on what is not finite.
STAGES: dict[str, tuple[tuple[str, ...], str]] = {
    "euler": ((), "h * a#"),
    "midpoint": (("u# + a# * half",), "h * b#"),
    "heun2": (("u# + h * a# * T(1.0)",), "h * (a# * T(0.5) + b# * T(0.5))"),
    "heun3": (
        ("u# + h * a# * T(1 / 3)", "u# + h * (a# * T(0.0) + b# * T(2 / 3))"),
        "h * (a# * T(0.25) + b# * T(0.0) + d# * T(0.75))",
    ),
    "rk4": (
        ("u# + h * a# * T(1 / 3)", "u# + h * (b# - a# * T(1 / 3))", "u# + h * (a# - b# + d#)"),
        "(a# + T(3.0) * (b# + d#) + e#) * h * T(0.125)",
    ),
}

RUN = '''T = np.{dtype}


@kernel(entry=True)
def run(first, last, at, columns, numbers, lengths):
    """Cells first … last − 1 in steps of these lengths; at (M, V) in place. columns (K, M), numbers
    (L,)."""
    for n in range(first, last):
        c = prepared({leaves})
        {u} = {start}
        for k in range(lengths.shape[0]):
            h, half = T(lengths[k]), T(0.5 * lengths[k])
            {stages}
            {u} = {end}
        {start} = {u}
'''


def method(name: str, size: int, dtype: str, leaves: str) -> str:
    """The loop over cells of a method, for so many variables. leaves: the text of a cell's."""
    many = lambda form: as_tuple([form.replace("#", str(k)) for k in range(size)])
    points, change = STAGES[name]
    lines = [
        f"{many(f'{slope}#')} = rates({many(at)}, c)"
        for slope, at in zip("abde", ("u#", *points), strict=False)
    ]
    return RUN.format(
        dtype=dtype, leaves=leaves, u=many("u#"), start=many("at[n, #]"),
        stages="\n            ".join(lines), end=many(f"u# + {change}"),
    )  # fmt: skip
