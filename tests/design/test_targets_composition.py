"""The target for the shares of strains."""

import math

import pytest
import torch

import torchfilm as tf
from design import Composition, Lasting, Parameter, Search, Weighted


def state(kinds, lengths=None, colonies=None) -> tf.State:
    count = len(kinds)
    cells = tf.Cells(
        [[9.0 * k, 0.0] for k in range(count)], [[1.0, 0.0]] * count, lengths or 2.0, 0.5,
        cell_type=kinds, colony=colonies,
    )  # fmt: skip
    return tf.Scene(tf.Growth(rate=1.0), founders=cells).bind().start()


def test_the_loss_by_hand():
    """Three of four cells of type 0, all alike: a share of 0.75, where it may be 0.4 to 0.6."""
    target = Composition({0: 0.5, 1: 0.5}, within=0.1)
    loss = target.loss(state([0, 0, 0, 1]))
    assert loss.tolist() == pytest.approx([(0.15 / 0.4) ** 2])
    assert target.loss(state([0, 1])).tolist() == [0.0]
    assert target.loss(state([1, 1])).tolist() == [1.0]


def test_shares_are_those_of_the_volume():
    target = Composition({1: 0.75})
    found = state([0, 1], lengths=[1.0 - 2 / 3, 3.0 - 2 / 3])  # V goes as l + 4r/3
    assert target.loss(found).tolist() == pytest.approx([0.0], abs=1e-12)
    assert float(target.measures(found)["share_1"]) == pytest.approx(0.75)


def test_each_colony_counts_alone():
    target = Composition({0: 0.5, 1: 0.5})
    batch = state([0, 1, 1, 1, 2, 0], colonies=[0, 0, 1, 1, 2, 2])
    assert target.loss(batch).tolist() == [0.0, 1.0, pytest.approx(0.5)]
    for k, one in enumerate(batch.select([k]) for k in range(3)):
        assert torch.equal(target.loss(one), target.loss(batch)[k : k + 1])


def test_measures_name_what_is_lost():
    found = Composition({0: 0.5, 1: 0.5, 7: 0.0}).measures(state([0, 0]))
    assert found["share_0"].tolist() == [1.0] and found["lost"].tolist() == [1.0]
    empty = state([0, 1]).remove(torch.tensor([True, True]), "removed")
    target = Composition({0: 0.5})
    assert target.loss(empty).tolist() == [1.5]
    assert math.isnan(float(target.measures(empty)["share_0"]))
    assert target.why_undefined("share_0") == "the colony has no cells"


def test_a_neutral_label():
    cells = tf.Cells([[0.0, 0.0], [9.0, 0.0]], [[1.0, 0.0]] * 2, extra={"label": [3.0, 4.0]})
    found = tf.Scene(tf.Growth(rate=1.0), founders=cells).bind().start()
    assert Composition({3: 0.5, 4: 0.5}, field="label").loss(found).tolist() == [0.0]


def mixed(seed):
    return tf.inoculum(8, 12.0, types={0: 0.5, 1: 0.5}, seed=seed)


def strains(rate):
    return tf.Scene(
        tf.Growth(rate={0: 1.0, 1: rate}), tf.Division(length=tf.Uniform(3.5, 4.0)),
        tf.Mechanics(dim=2), founders=mixed,
    )  # fmt: skip


def test_a_search_finds_the_rate_at_which_strains_keep_their_shares():
    target = Composition({0: 0.5, 1: 0.5}, within=0.02)
    search = Search(strains, [Parameter("rate", 0.4, 1.8)], target, until=2.0, replicates=2)
    best = search.run(colonies=60, progress=False)
    assert float(best.values["rate"]) == pytest.approx(1.0, abs=0.12)
    assert best.loss < 0.01 and "share_0" in best.table()


def test_it_may_last_and_be_weighed():
    lasting = Lasting(Composition({0: 0.5, 1: 0.5}, within=0.1), since=0.5)
    target = Weighted([(lasting, 1.0)])
    search = Search(strains, [Parameter("rate", 0.9, 1.1)], target, until=1.0, replicates=2)
    assert search.run(colonies=8, progress=False).loss < 0.05
    assert target.strains == "cell_type"  # by which pictures colour the cells


@pytest.mark.parametrize(
    ("build", "said"),
    [
        (lambda: Composition([0.5, 0.5]), r"Composition.shares = \[0.5, 0.5\] .*by cell type"),
        (lambda: Composition({}), r"a share by cell type"),
        (lambda: Composition({0: 0.7, 1: 0.7}), r"at most 1 together.*Their sum is 1.4"),
        (lambda: Composition({0: 1.5}), r"Composition.shares\[0\] = 1.5"),
        (lambda: Composition({"a": 0.5}), r"Composition.shares = 'a'"),
        (lambda: Composition({0: 0.5}, within=0.5), r"Composition.within = 0.5 .*below 0.5"),
        (lambda: Composition({0: 0.5}, field="a b"), r"Composition.field = 'a b'"),
        (
            lambda: Composition({0: 0.5}).check(
                tf.Scene(tf.Growth(rate=1.0), dim=2).bind().start()
            ),
            r"cell_type",
        ),
    ],
)
def test_what_is_refused(build, said):
    with pytest.raises(tf.InputError, match=said):
        build()
