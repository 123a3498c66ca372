"""A search says once what all its designs make one say."""

import warnings

import torchfilm as tf
from design import Measured, Parameter, Search, Sobol


def makes(u, s, p, cell):
    return {"m": p.k - u.m}


def most(state: tf.State):
    return state.groups.max(state.m)


def dim_colony(k=1.0) -> tf.Scene:
    """Its levels, in M, are far below the absolute tolerance of circuits."""
    return tf.Scene(
        tf.Circuit(makes, species="m", k=k), founders=tf.inoculum(4, radius=8.0, seed=1), dt=0.05
    )


def test_small_species_are_told_once_and_not_for_each_design():
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        search = Search(
            dim_colony, [Parameter("k", 1e-14, 1e-11, log=True)],
            Measured({"most": most}, {"most": 1.0}, {"most": 1.0}),
            until=0.1, replicates=1, method=Sobol(batch=4), seed=0, finals=None,
        )  # fmt: skip
        search.run(colonies=12, progress=False)
    small = [w for w in told if "its species are of about" in str(w.message)]
    assert len(small) == 2  # as the search is made, and as it runs
