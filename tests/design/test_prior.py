"""What is known of parameters before the data: draws, words, files, and what is refused."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats
from test_inference import colony, data, needs_sbi, task_of  # noqa: F401

import torchfilm as tf
from design import Choice, Parameter, infer
from design.parameters import Space
from design.prior import Prior
from design.simulations import simulate_designs

SPACE = Space(
    [
        Parameter("rate", 0.5, 2.0, log=True),
        Parameter("genes", 1, 4, whole=True),
        Choice("promoter", ("weak", "strong", "off")),
        Parameter("free", 0.0, 1.0),
    ]
)
KNOWN = {
    "rate": stats.lognorm(0.3, scale=1.2),
    "genes": stats.binom(4, 0.6),
    "promoter": {"weak": 0.7, "strong": 0.3, "off": 0.0},
}


def test_draws_follow_what_was_given():
    points = Prior(SPACE, KNOWN).points(np.random.default_rng(3).random((20_000, 4)))
    assert (points >= 0).all() and (points < 1).all()
    values = [SPACE.values(point) for point in points]
    rates = np.array([v["rate"] for v in values])
    whole = KNOWN["rate"]
    inside = lambda x: (whole.cdf(x) - whole.cdf(0.5)) / (whole.cdf(2.0) - whole.cdf(0.5))
    assert stats.kstest(rates, inside).pvalue > 0.01
    numbers = np.array([v["genes"] for v in values])
    expected = KNOWN["genes"].pmf([1, 2, 3, 4])
    expected = expected / expected.sum()  # none is outside the bounds
    shares = [(numbers == k).mean() for k in (1, 2, 3, 4)]
    assert shares == pytest.approx(expected, abs=0.015)
    promoters = [v["promoter"] for v in values]
    assert promoters.count("weak") / 20_000 == pytest.approx(0.7, abs=0.015)
    assert "off" not in promoters
    # spread over the share of a level, as draws without a prior are
    weak = points[[p == "weak" for p in promoters], 2]
    assert stats.kstest(weak * 3, "uniform").pvalue > 0.01
    assert stats.kstest(points[:, 3], "uniform").pvalue > 0.01


def test_nothing_given_changes_nothing():
    units = np.random.default_rng(0).random((5, 4))
    assert np.array_equal(Prior(SPACE).points(units), units)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ([1], "dictionary from parameters"),
        ({"rat": stats.norm()}, "did you mean 'rate'"),
        ({"rate": 1.2}, r"scipy.stats.lognorm\(0.3"),
        ({"rate": stats.norm}, "frozen distribution"),
        ({"rate": stats.poisson(1.0)}, "frozen distribution"),
        ({"genes": stats.norm(2, 1)}, "discrete distribution"),
        ({"rate": stats.norm([1, 2], 1)}, "one distribution, not several"),
        ({"rate": stats.norm(20.0, 1.0)}, "at least 0.001 lies within the bounds"),
        ({"promoter": {"weak": 1.0}}, "share of each option"),
        ({"promoter": {"weak": 0.5, "strong": 0.6, "off": 0.0}}, "add up to 1"),
        ({"promoter": {"weak": 1.5, "strong": -0.5, "off": 0.0}}, "at least 0"),
    ],
)
def test_what_is_no_prior_is_refused(given, message):
    with pytest.raises(tf.InputError, match=f"(?i){message}"):
        Prior(SPACE, given)


def test_a_file_keeps_to_its_prior(data, tmp_path):  # noqa: F811
    task, path = task_of(data), tmp_path / "simulations.h5"
    prior = Prior(task.space, {"rate": stats.norm(1.4, 0.1)})
    one = simulate_designs(task, 4, prior=prior, path=path)
    assert np.array_equal(simulate_designs(task, 4, prior=prior, path=path).points, one.points)
    for other in (None, Prior(task.space, {"rate": stats.norm(1.4, 0.2)})):
        with pytest.raises(tf.InputError, match="differs in prior"):
            simulate_designs(task, 4, prior=other, path=path)


def test_distributions_are_told_apart_by_their_numbers():
    made = lambda edges: stats.rv_histogram((np.array([1.0, 2.0]), np.array(edges)), density=True)()
    of = lambda known: Prior(SPACE, {"rate": known}).describe()
    assert of(made([0.6, 1.0, 1.5])) != of(made([0.6, 1.2, 1.5]))
    assert of(stats.norm(np.float64(1), 0.5)) == of(stats.norm(loc=1, scale=0.5))


@needs_sbi
def test_where_the_data_say_nothing_the_posterior_is_the_prior(data, tmp_path):  # noqa: F811
    parameters = [Parameter("rate", 0.8, 2.0, log=True), Parameter("make", 0.2, 3.0)]
    found = infer(
        colony, parameters, data, until=2.0, dt=0.1, simulations=300, seed=2, progress=False,
        prior={"make": stats.norm(1, 0.15)},
    )  # fmt: skip
    make = found.samples["make"]
    assert make.mean() == pytest.approx(1.0, abs=0.08) and 0.09 < make.std() < 0.24
    assert "of 0.2 to 3, norm(1, 0.15)" in found.table()
    picture = found.plot(tmp_path / "posterior.png")
    assert "line: before the data" in picture.figure.get_suptitle().replace("\n", " ")
