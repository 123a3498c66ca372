"""The state: a frozen flat batch; selecting, taking, removing, declaring, moving."""

from __future__ import annotations

import copy
import dataclasses
import math
import pickle

import pytest
import torch
from helpers import step

import torchfilm as tf
from torchfilm.state import PER_CELL


def batch(counts: tuple[int, ...] = (2, 0, 3, 1), **options) -> tf.State:
    """A bare state with colonies of these sizes; cell k of colony c stands at (10 c, k)."""
    colony = [c for c, n in enumerate(counts) for _ in range(n)]
    within = [k for n in counts for k in range(n)]
    cells = tf.Cells(
        [[10.0 * c, 1.0 * k] for c, k in zip(colony, within, strict=True)],
        [[1.0, 0.0]] * len(colony),
        colony=colony,
    )
    return tf.Scene(tf.Growth(rate=1.0), founders=cells).bind(len(counts), **options).start()


def test_sizes():
    state = batch()
    assert (state.cells, state.colonies, state.dim) == (6, 4, 2)
    assert state.counts.tolist() == [2, 0, 3, 1]
    assert state.colony.tolist() == [0, 0, 2, 2, 2, 3]
    assert state.uid.tolist() == [0, 1, 0, 1, 2, 0] and state.parent.tolist() == [-1] * 6
    assert state.next_uid.tolist() == [2, 0, 3, 1]


def test_dtype_and_device(device, dtype):
    state = batch(device=device, dtype=dtype)
    assert state.dtype == dtype and state.device.type == device.type
    assert state.axis.dtype == state.radius.dtype == state.growth_rate.dtype == dtype
    assert state.position.dtype == torch.float64, (
        "positions keep their resolution far from the origin"
    )
    assert state.uid.dtype == state.colony.dtype == torch.int64


def test_volume_and_area(dtype):
    state = batch(dtype=dtype)
    eps = 4 * torch.finfo(dtype).eps
    assert float(state.volume[0]) == pytest.approx(math.pi * 0.25 * (2 + 2 / 3), rel=eps)
    assert float(state.area[0]) == pytest.approx(2 * math.pi * 0.5 * 3, rel=eps)


def test_frozen():
    state = batch()
    with pytest.raises(dataclasses.FrozenInstanceError):
        state.length = state.length * 2
    with pytest.raises(dataclasses.FrozenInstanceError):
        del state.uid
    with pytest.raises(dataclasses.FrozenInstanceError):
        state.growth_rate = state.growth_rate * 2


def test_fields_are_attributes_and_unknown_names_are_reported():
    state = batch()
    assert state.growth_rate is state.fields["growth_rate"]
    message = r"'grwth_rate'. Did you mean 'growth_rate'.*radius it has the fields growth_rate\."
    with pytest.raises(AttributeError, match=message):
        state.grwth_rate  # noqa: B018
    assert not hasattr(state, "displacement")
    with pytest.raises(AttributeError, match=r"no 'y'\. It is position\[:, 1\]\."):
        state.y  # noqa: B018


def test_names_of_fields_are_completed():
    """But not those that serve the numerics, nor signals, which are no attributes."""
    hidden = tf.Field("hidden", "of the numerics", internal=True)
    names = dir(batch().declare(hidden))
    assert {"growth_rate", "position", "counts", "take"} <= set(names) and "hidden" not in names
    assert all(name.isidentifier() for name in dir(tf.scenes.quorum_sensing().bind().start()))


def test_an_unknown_signal_is_named_beside_those_there_are():
    medium = tf.Medium(
        ahl=tf.Signal(diffusion=1.0),
        food=tf.Signal(diffusion=1.0),
        box=((-4, -4), (4, 4)),
        spacing=4.0,
    )
    signals = tf.Scene(medium, founders=tf.Cells.single(2)).bind().start().signals
    assert (
        list(signals) == ["ahl", "food"]
        and signals["ahl"].numel() == 4
        and signals.get("alh") is None
    )
    for error in (tf.InputError, KeyError):
        with pytest.raises(
            error, match=r"^the state has no signal 'alh'; its signals are ahl, food$"
        ):
            signals["alh"]
    with pytest.raises(tf.InputError, match=r"no signal 'ahl'.*none: list a Medium"):
        batch().signals["ahl"]


def test_replace_leaves_the_old_one():
    state = batch()
    new = state.replace(length=state.length * 2)
    assert state.length[0] == 2 and new.length[0] == 4
    assert new.uid is state.uid


def test_counts_follow_a_replaced_colony():
    """What a state works out once must not be carried over to another."""
    state = batch((2, 2))
    assert state.counts.tolist() == [2, 2]
    assert state.take(torch.tensor([0, 2, 3])).counts.tolist() == [1, 2]


def test_what_a_state_works_out_follows_each_part_that_it_is_of():
    medium = tf.Medium(a=tf.Signal(1.0), box=((-4, -4), (4, 4)), spacing=4.0)
    state = tf.Scene(medium, founders=tf.Cells.single(2)).bind(2).start()
    before = state.volume, state.area, state.counts, state.position_3d
    for part in ("length", "radius"):
        longer = state.replace(**{part: 2 * getattr(state, part)})
        assert bool((longer.volume > before[0]).all()) and bool((longer.area > before[1]).all())
    more = state.replace(colony_id=torch.arange(3))
    assert more.counts.tolist() == [1, 1, 0] and more.groups.size == 3
    higher = state.replace(layout=dataclasses.replace(state.layout, height=0.5))
    assert before[3][:, 2].tolist() == [0.0, 0.0] and higher.position_3d[:, 2].tolist() == [0.5] * 2
    assert state.replace(position=state.position + 1.0).position_3d[0].tolist() == [1.0, 1.0, 0.0]


@pytest.mark.parametrize("part", ["length", "radius"])
def test_a_volume_that_was_asked_for_without_gradients_has_them_later(part):
    state = batch()
    state = state.replace(**{part: getattr(state, part).clone().requires_grad_()})
    with torch.no_grad():
        assert not state.volume.requires_grad and not state.area.requires_grad
    assert state.volume.requires_grad and state.area.requires_grad


# --- select, take, remove -------------------------------------------------------------------------


def test_select_in_the_order_given():
    part = batch().select([3, 0, 1])
    assert part.counts.tolist() == [1, 2, 0] and part.colony.tolist() == [0, 1, 1]
    assert part.position.tolist() == [[30.0, 0.0], [0.0, 0.0], [0.0, 1.0]]
    assert part.colony_id.tolist() == [3, 0, 1] and part.next_uid.tolist() == [1, 2, 0]
    assert part.own_colony_id.tolist() == [3, 0, 0]


def test_select_of_a_selection_keeps_the_first_ids():
    assert batch().select([3, 2, 0]).select([1]).colony_id.tolist() == [2]


def test_a_place_gets_the_colony_that_is_named_for_it():
    state = batch()
    mixed = state.put([0, 3], state, taken=[2, 0])
    assert mixed.counts.tolist() == [3, 0, 3, 2] and mixed.colony_id.tolist() == [0, 1, 2, 3]
    assert mixed.position[:, 0].tolist() == [20.0] * 6 + [0.0] * 2


def test_select_takes_fields_per_colony_along():
    field = tf.Field(
        "medium", "of a colony", scope="colony", initial=lambda s, rows: rows.double() * 10
    )
    part = batch().declare(field).select([2, 0])
    assert part.medium.tolist() == [20.0, 0.0]
    assert part.growth_rate.tolist() == [1.0] * 5


def test_select_takes_tensors():
    assert batch().select(torch.tensor([2])).counts.tolist() == [3]


@pytest.mark.parametrize("places", [[4], [-1], [], [0, 0]])
def test_select_refuses_places_that_are_not_there(places):
    with pytest.raises(tf.InputError, match="colonies"):
        batch().select(places)


def test_take_keeps_every_colony():
    part = batch().take(torch.tensor([1, 5]))
    assert part.colonies == 4 and part.counts.tolist() == [1, 0, 0, 1]
    assert part.uid.tolist() == [1, 0]


def test_take_may_repeat_a_cell():
    assert batch().take(torch.tensor([0, 0, 1])).position.tolist() == [
        [0.0, 0.0],
        [0.0, 0.0],
        [0.0, 1.0],
    ]


def test_take_passes_gradients():
    state = batch()
    length = state.length.clone().requires_grad_()
    state.replace(length=length).take(torch.tensor([0, 0, 3])).length.sum().backward()
    assert length.grad.tolist() == [2.0, 0.0, 0.0, 1.0, 0.0, 0.0]


def test_remove_notes_the_end():
    state = batch()
    gone = torch.tensor([False, True, False, False, True, False])
    left = state.remove(gone, "removed")
    assert left.cells == 4 and left.counts.tolist() == [1, 0, 2, 1]
    assert left.uid.tolist() == [0, 0, 1, 0] and left.next_uid.tolist() == [2, 0, 3, 1], (
        "ids are not given out again"
    )
    (note,) = left.ended
    assert (note.fate, note.colony_id.tolist(), note.uid.tolist()) == ("removed", [0, 2], [1, 2])
    again = left.remove(torch.tensor([True, False, False, False]), "left")
    assert [n.fate for n in again.ended] == ["removed", "left"]


def test_remove_nobody_is_the_same_state():
    state = batch()
    assert state.remove(torch.zeros(6, dtype=torch.bool), "removed") is state


def test_remove_in_a_selection_names_the_colonies_own_ids():
    (note,) = batch().select([3, 0]).remove(torch.tensor([True, False, False]), "left").ended
    assert note.colony_id.tolist() == [3] and note.uid.tolist() == [0]


# --- declare and with_fields ----------------------------------------------------------------------


def test_declare_fields_of_every_kind():
    state = batch()
    state = state.declare(tf.Field("heat", "a number", initial=2.5))
    state = state.declare(tf.Field("pair", "two numbers", shape=(2,), initial=1.0))
    state = state.declare(tf.Field("kind", "a whole number", dtype=torch.int64, initial=3))
    state = state.declare(tf.Field("plate", "per colony", scope="colony"))
    state = state.declare(
        tf.Field("own", "worked out", initial=lambda s, rows: s.position[rows, 1])
    )
    assert state.heat.tolist() == [2.5] * 6 and state.heat.dtype == state.dtype
    assert (
        state.pair.shape == (6, 2) and state.kind.dtype == torch.int64 and state.plate.shape == (4,)
    )
    assert state.own.tolist() == [0.0, 1.0, 0.0, 1.0, 2.0, 0.0] and state.own.dtype == state.dtype


def test_declare_refuses_a_first_value_of_wrong_length():
    with pytest.raises(tf.InputError, match="heat"):
        batch().declare(tf.Field("heat", "three numbers", initial=lambda s, rows: torch.ones(3)))


@pytest.mark.parametrize(
    "name", ["length", "uid", "volume", "select", "fields", "two words", "3rd"]
)
def test_field_names_that_cannot_be_used_are_refused(name):
    with pytest.raises(tf.InputError, match=r"Field\.name"):
        tf.Field(name, "no good")


@pytest.mark.parametrize("options", [{"scope": "moon"}, {"at_division": "halve"}])
def test_unknown_options_of_a_field_are_refused(options):
    with pytest.raises(tf.InputError, match="heat"):
        tf.Field("heat", "no good", **options)


def test_with_fields_refuses_what_is_not_declared():
    with pytest.raises(tf.InputError, match=r"'heat'.*growth_rate"):
        batch().with_fields(heat=torch.zeros(6))


# --- device and draws -----------------------------------------------------------------------------


def test_to_moves_everything(device):
    state = batch().to(device)
    for name in (*PER_CELL, "colony_id", "next_uid"):
        assert getattr(state, name).device.type == device.type
    assert all(v.device.type == device.type for v in state.fields.values())
    scene = tf.Scene(tf.Growth(rate=1.0), founders=tf.Cells.single(2))
    assert step(scene, state, 0.1).length.device.type == device.type


def test_draws_are_keyed_by_seed_colony_cell_step_and_purpose():
    state = batch((2, 2))
    rows = torch.arange(4)
    drawn = state.uniform(rows, "test")
    assert torch.unique(drawn).numel() == 4 and ((drawn > 0) & (drawn < 1)).all()
    assert torch.equal(drawn, state.uniform(rows, "test")), "a draw is a function, not an event"
    assert torch.equal(state.select([1]).uniform(torch.arange(2), "test"), drawn[2:])
    assert torch.equal(state.uniform(torch.tensor([3]), "test"), drawn[3:])
    for other in (
        state.uniform(rows, "another"),
        state.replace(step=1).uniform(rows, "test"),
        state.replace(seed=1).uniform(rows, "test"),
    ):
        assert not (other == drawn).any()


def test_repr_is_one_line_of_what_matters():
    assert (
        repr(batch())
        == "State(4 colonies, 6 cells, 2-D, t = 0 h, step 0, float32 on cpu, fields: growth_rate)"
    )
    one = tf.scenes.microcolony().bind().start()
    assert repr(one).startswith("State(1 colony, 1 cell, 2-D")
    assert repr(one).endswith("fields: division_threshold, growth_rate)")


def test_volumes_that_were_asked_for_without_gradients_still_have_them():
    """A volume is worked out once for a state: not so that `no_grad` takes its gradient away, nor
    after the length has changed."""
    state = tf.Scene(tf.Growth(rate=1.0)).bind(dtype=torch.float64).start()
    first = state.volume
    assert state.volume is first
    longer = state.replace(length=state.length.clone().requires_grad_())
    with torch.no_grad():
        assert float(longer.volume) == float(first) and not longer.area.requires_grad
    (slope,) = torch.autograd.grad((longer.volume + longer.area).sum(), longer.length)
    r = float(state.radius)
    assert float(slope) == pytest.approx(math.pi * r * r + 2 * math.pi * r)
    assert float(state.replace(length=2 * state.length).volume) > float(first)


# --- wrong input ----------------------------------------------------------------------------------

FIRST = torch.tensor([0])
WRONG = {
    "a part": (
        lambda s: s.replace(lenght=s.length),
        r"State\.replace has no parameter 'lenght'\. Did you mean length",
    ),
    "a number": (lambda s: s.with_fields(growth_rate=1.0), r"'growth_rate' = 1\.0.*a tensor"),
    "no field": (lambda s: s.declare("gfp"), r"field = 'gfp'.*tf\.Field"),
    "a list": (lambda s: s.take([0]), r"index = \[0\].*whole numbers from 0 to 5"),
    "floats": (lambda s: s.take(torch.tensor([0.5])), r"index = tensor.*whole numbers from 0 to 5"),
    "no row": (lambda s: s.take(torch.tensor([9])), r"index = \[9\].*from 0 to 5"),
    "numbers": (lambda s: s.remove(FIRST, "left"), r"gone = tensor.*shape \(6,\).*torch\.bool"),
    "a fate": (
        lambda s: s.remove(torch.zeros(6, dtype=torch.bool) | True, "lost"),
        r"fate = 'lost'.*'divided', 'removed', 'left', 'failed'",
    ),
    "no places": (lambda s: s.select("a"), r"colonies = 'a'.*whole numbers"),
    "None": (lambda s: s.select(None), r"colonies = None.*whole numbers"),
    "parts of places": (lambda s: s.select([0.5]), r"colonies = \[0\.5\].*whole numbers"),
    "a mask": (lambda s: s.select(torch.arange(4) > 1), r"colonies = tensor.*nonzero\(mask\)"),
    "a device": (lambda s: s.to("gpu"), r'device = \'gpu\'.*"cpu" or "cuda"'),
    "rows": (lambda s: s.uniform([0], "x"), r"rows = \[0\].*whole numbers"),
    "rows beyond": (lambda s: s.normal(torch.tensor([9]), "x"), r"rows = \[9\].*from 0 to 5"),
    "a purpose": (lambda s: s.uniform(FIRST, 3), r"purpose = 3.*a text"),
    "a medium": (lambda s: s.position_3d, r"no medium: list a Medium"),
    "a name": (lambda s: tf.Field(3, "three"), r"Field\.name = 3.*a text"),
    "a shape": (lambda s: tf.Field("heat", "", shape=3), r"'heat'\)\.shape = 3.*a tuple"),
    "a value": (lambda s: tf.Field("heat", "", initial="hot"), r"initial = 'hot'.*a number"),
}


@pytest.mark.parametrize("case", WRONG)
def test_wrong_input_is_named(case):
    call, message = WRONG[case]
    state = batch()
    with pytest.raises(tf.InputError, match=message):
        call(state)


@pytest.mark.parametrize("name", ["quorum_sensing", "toggle_switch", "nutrient_limited", "channel"])
@pytest.mark.parametrize("copied", [lambda s: pickle.loads(pickle.dumps(s)), copy.deepcopy])
def test_a_state_may_be_sent_or_copied_and_goes_on_as_the_first_does(name, copied):
    scene = getattr(tf.scenes, name)()
    *_, state = tf.simulate(scene, colonies=2, until=0.5)
    ends = []
    for start in (state, copied(state)):
        *_, end = tf.simulate(scene.bind(state=start), start, until=0.7)
        ends.append(end)
    assert all(torch.equal(ends[0].fields[n], ends[1].fields[n]) for n in state.fields)
    assert torch.equal(ends[0].position, ends[1].position)


@pytest.mark.parametrize(
    "change, words",
    [
        (lambda s: {"colony": s.colony.flip(0)}, r"state\.colony\[\d\].*side by side"),
        (lambda s: {"length": -s.length}, r"state\.length\[0\] = -2.*at least 0 µm"),
        (lambda s: {"radius": 0 * s.radius}, r"state\.radius\[0\] = 0.*above 0 µm"),
        (lambda s: {"axis": s.axis.double()}, r"state\.axis = .*float64.*torch\.float32"),
        (lambda s: {"uid": s.uid[:2]}, r"state\.uid = .\(2,\).*shape \(6,\)"),
        (lambda s: {"position": s.position[:, :1]}, r"position = \(6, 1\)|-D"),
    ],
)
def test_a_state_that_was_edited_is_checked_before_it_is_run(change, words):
    state = batch()
    model = tf.Scene(tf.Growth(rate=1.0), dim=2).bind(state=state)
    with pytest.raises(tf.InputError, match=words):
        tf.simulate(model, state.replace(**change(state)), until=0.1)
    with pytest.raises(tf.InputError, match="one value for each cell"):
        short = state.with_fields(growth_rate=state.growth_rate[:2])
        tf.simulate(model, short, until=0.1)


def plain() -> tf.Scene:
    return tf.Scene(tf.Growth(rate=1.0), tf.Division(length=4.0), dim=2, dt=0.05)


def test_a_stream_is_that_of_the_place():
    state = plain().bind(3, seed=7).start().replace(stream=torch.tensor([7, 9, 7]))
    assert state.own_stream.tolist() == [7, 9, 7] and state.select([1]).own_stream.tolist() == [9]
    assert plain().bind(state=state).seed == 7


@pytest.mark.parametrize("initial", [0.0, lambda state, rows: torch.zeros(len(rows))])
def test_fields_of_colonies_stay_as_cells_divide(initial):
    field = tf.Field("dose", "", scope="colony", at_division="reset", initial=initial)
    state = plain().bind(2).start().declare(field).with_fields(dose=torch.tensor([1.0, 2.0]))
    model = plain().bind(state=state)
    while not state.births:
        state = model.step(state)
    made = state.reset_at_division(torch.tensor([0, 1]), ["dose"])
    assert state.dose.tolist() == made.dose.tolist() == [1.0, 2.0]


def test_arrivals_move_with_a_state_and_a_selection_has_none():
    model = plain().bind(2)
    state = model.add(model.start(), tf.Cells([[20.0, 0.0]], [[1.0, 0.0]]))
    assert state.arrived and not state.select([0]).arrived
    real = lambda x: isinstance(x, torch.Tensor) and x.is_floating_point()
    moved = state.moved(lambda x: x.double() if real(x) else x)
    assert moved.arrived[0].length.dtype == torch.float64


@pytest.mark.parametrize(
    "found", [lambda n: torch.zeros(n), lambda n: 1.0, lambda n: torch.ones(())]
)
def test_a_first_value_of_another_shape_is_refused(found):
    field = tf.Field("v", "", shape=(3,), initial=lambda state, rows: found(len(rows)))
    words = r"Field\('v'\)\.initial\(state, rows\) = .*a tensor of shape \(3, 3\)"
    with pytest.raises(tf.InputError, match=words):
        plain().bind(3).start().declare(field)
