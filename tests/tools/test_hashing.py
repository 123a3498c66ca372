"""A digest differs for objects that act differently, and only for those."""

from __future__ import annotations

import os
import subprocess
import sys
from collections import deque
from dataclasses import dataclass, field
from datetime import datetime, tzinfo
from decimal import Decimal
from functools import partial
from types import ModuleType

import numpy as np
import pytest
import torch

from torchfilm.tools.hashing import digest, digest_of_code, digest_of_weights, networks, trained


def made(code: str):
    names: dict = {}
    exec(code, names)
    return names["f"]


def holding(x):
    return lambda y: x + y


@dataclass
class Thing:
    size: float
    worked_out: object = field(default=None, repr=False)


class Adding:
    def __init__(self, size):
        self.size = size

    def to(self, x):
        return x + self.size


class Slotted:
    __slots__ = ("__hidden", "size")

    def __init__(self, size, hidden):
        self.size, self.__hidden = size, hidden


def using(size):
    """A function that relies on an object of its own module."""
    code = "class Nutrients:\n  def __init__(self, size): self.size = size\n"
    names: dict = {"__name__": "of_a_user"}
    exec(f"{code}nutrients = Nutrients({size})\ndef f(x): return x + nutrients.size", names)
    return names["f"]


@pytest.mark.parametrize(
    "one, other",
    [
        (1, 1.0),
        (1.0, 1.0 + 1e-15),
        ("a", b"a"),
        ((1, 2), (2, 1)),
        ({"a": 1}, {"b": 1}),
        (np.arange(3), np.arange(3.0)),
        (torch.tensor([1.0, 2.0]), torch.tensor([[1.0], [2.0]])),
        (torch.tensor(1.0), torch.tensor(1.0000001)),
        (made("def f(x): return x + 1"), made("def f(x): return x + 2")),
        (made("def f(x): return x + 1"), made("def f(x): return x - 1")),
        (made("def f(x, k=1): return x + k"), made("def f(x, k=2): return x + k")),
        (
            made("def f(x):\n  def g(y): return y\n  return g(x)"),
            made("def f(x):\n  def g(y): return -y\n  return g(x)"),
        ),
        (
            made("import math\ndef f(x): return math.sin(x)"),
            made("import math\ndef f(x): return math.cos(x)"),
        ),
        (holding(1), holding(2)),
        (Thing(1.0), Thing(2.0)),
        (Adding(1.0).to, Adding(2.0).to),
        (Slotted(1.0, 0), Slotted(2.0, 0)),
        (Slotted(1.0, 0), Slotted(1.0, 1)),
        (using(1.0), using(2.0)),
        (
            partial(made("def f(x, k): return x + k"), k=1),
            partial(made("def f(x, k): return x - k"), k=1),
        ),
        (partial(holding, 1), partial(holding, 2)),
    ],
)
def test_what_differs_is_distinguished(one, other):
    assert digest(one) != digest(other) and digest(one) == digest(one)


@pytest.mark.parametrize(
    "one, other",
    [
        (made("def f(x): return x + 1"), made("\n\n# a remark\ndef f(x):\n    return x + 1")),
        (holding(3), holding(3)),
        (Thing(1.0, worked_out=object()), Thing(1.0)),
        (torch.tensor([1.0, 2.0]), np.array([1.0, 2.0], np.float32)),
        ([object()], [object()]),
        ((2.0, (1, "a")), [2.0, [1, "a"]]),
        (
            made('def f(x):\n  "Adds one."\n  return x + 1'),
            made('def f(x):\n  "Adds 1 to x."\n  return x + 1'),
        ),
        (made("size = 3\ndef f(x): return x.size"), made("size = 4\ndef f(x): return x.size")),
        (Adding(1.0).to, Adding(1.0).to),
        (Slotted(1.0, 0), Slotted(1.0, 0)),
        (using(1.0), using(1.0)),
        (partial(holding, 1), partial(holding, 1)),
    ],
)
def test_what_acts_alike_is_alike(one, other):
    assert digest(one) == digest(other)


def test_a_function_that_calls_itself_has_an_end():
    def again(n):
        return again(n - 1) if n else 0

    assert digest(again) == digest(again)


def test_objects_that_refer_to_one_another_take_no_long_time():
    """A way through all of n objects goes n! ways: 20 of them would never end."""

    def knot(size):
        things = [Adding(float(k)) for k in range(20)]
        for one in things:
            one.others = things
        things[7].size = size
        return things[0]

    assert digest(knot(7.0)) == digest(knot(7.0)) != digest(knot(8.0))


# --- networks -------------------------------------------------------------------------------------


class Own(torch.nn.Module):
    def __init__(self):
        super().__init__()
        self.scale = torch.nn.Parameter(torch.ones(1))
        self.inner = torch.nn.Sequential(torch.nn.Linear(2, 3), torch.nn.BatchNorm1d(3))

    def forward(self, x):
        return self.scale * self.inner(x)


def made_of(net):
    return lambda x: net(x)


def trained_one(make, step):
    torch.manual_seed(0)
    net = make()
    with torch.no_grad():
        for x in (*net.parameters(), *net.buffers()):
            x += step
    return net


MODULES = {
    "linear": lambda: torch.nn.Linear(2, 3),
    "sequence": lambda: torch.nn.Sequential(torch.nn.Linear(2, 3), torch.nn.Tanh()),
    "norm": lambda: torch.nn.BatchNorm1d(3),
    "own": Own,
}


@pytest.mark.parametrize("make", MODULES.values(), ids=MODULES)
@pytest.mark.parametrize("held", [lambda net: net, made_of, lambda net: {"net": [net]}, Thing])
def test_weights_count_but_not_for_the_code(make, held):
    one, same, other = (held(trained_one(make, step)) for step in (0, 0, 1))
    assert digest(one) == digest(same) != digest(other)
    assert digest_of_weights(one) == digest_of_weights(same) != digest_of_weights(other)
    assert digest_of_code(one) == digest_of_code(other)
    assert len(networks(one)) == 1


def test_the_form_of_a_network_counts_for_the_code():
    code = [digest_of_code(torch.nn.Sequential(torch.nn.Linear(2, n))) for n in (2, 3)]
    assert code[0] != code[1]
    assert digest_of_weights(made_of(3.0)) == "" and networks(made_of(3.0)) == []


NET = torch.nn.Linear(1, 1)


def test_a_network_that_a_function_finds_by_its_name_counts():
    def f(x):
        return NET(x)

    before, code = digest(f), digest_of_code(f)
    with torch.no_grad():
        NET.weight += 1.0
    assert digest(f) != before and digest_of_code(f) == code
    assert [id(x) for x in trained(f)] == [id(x) for x in NET.parameters()]


def test_what_an_optimiser_may_change():
    weight, number = torch.ones(1, requires_grad=True), torch.ones(1)
    net, bent = torch.nn.Linear(2, 1), 2 * weight

    def f(x):
        return net(x) + weight * number + bent

    found = {id(x) for x in trained(f, {"again": net})}
    assert found == {id(weight), *map(id, net.parameters())}


def test_a_module_that_comes_again_counts_in_each_place():
    a, b = torch.nn.Linear(2, 2), torch.nn.Linear(2, 2)
    same, other = torch.nn.Sequential(a, b, a), torch.nn.Sequential(a, b, b)
    assert digest(same) != digest(other)


def test_buffers_count_and_those_that_change_while_running_do_not_for_files():
    one, other = torch.nn.BatchNorm1d(3), torch.nn.BatchNorm1d(3)
    other.running_mean += 1.0
    assert digest(one) != digest(other)
    assert digest_of_weights(one) == digest_of_weights(other)
    assert digest_of_weights(one.eval()) != digest_of_weights(other.eval())


@pytest.mark.parametrize("make", [Own, lambda: torch.nn.Linear(2, 2)])
def test_the_mode_of_a_module_and_its_hooks_are_no_code(make):
    net, other = (trained_one(make, 0) for _ in range(2))
    other.eval().register_forward_hook(lambda *given: None)
    assert digest_of_code(net) == digest_of_code(other)


@pytest.mark.parametrize(
    "net",
    [
        torch.nn.LazyLinear(3),
        torch.nn.Linear(2, 2).bfloat16(),
        torch.nn.Linear(2, 2, device="meta"),
    ],
)
def test_modules_without_usual_numbers(net):
    assert digest(net) == digest(net) and digest_of_weights(net) == digest_of_weights(net)
    assert digest_of_code(net) and isinstance(trained(net), list)


def test_networks_of_inference_mode_are_not_watched():
    with torch.inference_mode():
        net = torch.nn.Linear(2, 2)
    assert trained(net, torch.nn.LazyLinear(3)) == []


def test_what_a_class_holds_counts():
    def made(step):
        class Holding:
            net = trained_one(lambda: torch.nn.Linear(1, 1), step)

        return Holding()

    assert digest(made(0)) == digest(made(0)) != digest(made(1))
    assert len(networks(made(0))) == 1


def of_user(code, name="f"):
    names = {"__name__": "of_a_user"}
    exec(code, names)
    return names[name]


def of_class(body):
    return of_user(f"class Own:\n  {body}\n", "Own")()


CACHING = "import functools\n@functools.cache\ndef g(x): return x + {}\ndef f(x): return g(x)"
WITHIN = "import math\ndef f(x): return [math.{}(y) for y in x]"
CAUGHT = "def f(x):\n  try:\n    y = x[0]\n{}  except KeyError:\n    return 0\n{}  return y"
HOLDING = (
    "import numpy as np, types, collections, datetime, decimal, fractions, functools\n"
    "K = {}\ndef f(x): return x, K"
)
KINDS = (
    "np.float32({})", "np.int64({})", "complex({})", "bytes({})", "{{{}}}", "frozenset([{}])",
    "range({})", "types.SimpleNamespace(k={})", "types.MappingProxyType(dict(k={}))",
    "collections.deque([{}])", "decimal.Decimal({})", "fractions.Fraction({})",
    "functools.partial(max, {})", "np.array([{}, None], dtype=object)",
    "[np.datetime64(1, 's'), np.datetime64({}, 's')]", "datetime.date(2026, 1, {})",
 "np.array([({}, None)], dtype=[('a', int), ('b', object)])",
)  # fmt: skip


@pytest.mark.parametrize(
    "code, one, other",
    [
        ("def f(x, *, k={}): return x + k", 1, 2),
        ("K = {}\ndef f(x): return [y + K for y in x]", 1.0, 2.0),
        (WITHIN, "sin", "cos"),
        (CACHING, 1, 2),
        ("def f({}x): return x", "", "*"),
        ("def f(x):\n  try: y = x[0]\n  except KeyError: {}\n  return 1", "y = 1", "y = 2"),
        ("{}", CAUGHT.format("    len(y)\n", ""), CAUGHT.format("", "  else:\n    len(y)\n")),
        *((HOLDING, kind.format(1), kind.format(2)) for kind in KINDS),
    ],
)
def test_what_a_function_uses_counts(code, one, other):
    first, again, second = (digest(of_user(code.format(x))) for x in (one, one, other))
    assert first == again != second


def test_an_object_in_another_module_of_the_user_counts(monkeypatch):
    """As the functions that are there do."""
    found = []
    for size in (1, 1, 2):
        other = ModuleType("settings_of_a_user")
        lines = f"class Box: size = 0\nbox = Box()\nbox.size = {size}"
        exec(lines, vars(other))
        monkeypatch.setitem(sys.modules, "settings_of_a_user", other)
        function = of_user("from settings_of_a_user import box\ndef f(x): return x + box.size")
        found.append(digest(function))
    assert found[0] == found[1] != found[2]


@pytest.mark.parametrize(
    "plain, told",
    [
        ("def f(x):\n  x.age = x.age + 1", "def f(x):\n  'Ages.'\n  x.age = x.age + 1"),
        ("def f(x): return None, 1, x", "def f(x):\n  '''Three.'''\n  return None, 1, x"),
        (
            "def f(x):\n  def g(y): y.age = 1.5\n  return g(x)",
            "def f(x):\n  def g(y):\n    'Sets.'\n    y.age = 1.5\n  return g(x)",
        ),
    ],
)
def test_a_new_docstring_changes_nothing(plain, told):
    assert digest(of_user(plain)) == digest(of_user(told))


@pytest.mark.parametrize(
    "body",
    [
        "size = property(lambda self: 1, lambda self, x: x + {})",
        "k = classmethod(lambda kind: {})",
        "k = staticmethod(lambda: {})",
        "k = {}",
    ],
)
def test_what_a_class_holds_counts_but_for_private_values(body):
    one, again, other = (digest(of_class(body.format(k))) for k in (1, 1, 2))
    assert one == again != other
    assert digest(of_class("_seen = 1")) == digest(of_class("_seen = 2"))


def test_keywords_of_a_partial_function_count():
    base = of_user("def f(x, k): return x + k")
    assert digest(partial(base, k=1)) != digest(partial(base, k=2))


def test_arrays_count_by_what_they_hold():
    a = np.arange(6.0).reshape(2, 3)
    assert digest(np.asfortranarray(a)) == digest(a) and digest(a.T) == digest(a.T.copy())
    assert digest(a) != digest(a[:, ::-1])
    text = "x" * int("3")  # an object of its own
    assert digest(np.array(["xxx", None])) == digest(np.array([text, None]))
    assert digest(np.array(["xxx", None])) != digest(np.array(["xxy", None]))
    assert digest(1.5) == digest(np.float64(1.5)) == digest(np.float32(1.5))


def test_an_array_in_itself_and_equal_values_apart():
    array = np.empty(1, dtype=object)
    array[0] = array
    assert digest(array) == digest(array)
    make = lambda: (Decimal("1.5"), deque([1, 2]), range(3))
    again = make()
    assert digest([again, again]) == digest([make(), make()])


def test_sets_of_objects_that_refer_to_each_other():
    class Node:
        def __init__(self, size):
            self.size, self.near = size, set()

    def pair(one, other):
        a, b = Node(one), Node(other)
        a.near.add(b)
        b.near.add(a)
        return a

    assert digest(pair(1.0, 2.0)) == digest(pair(1.0, 2.0)) != digest(pair(1.0, 3.0))
    chain = Node(0.0)
    for k in range(40):  # each is looked at once
        above = Node(float(k))
        above.near.add(chain)
        chain = above
    assert digest(chain) == digest(chain)


def test_paths_and_addresses_do_not_count():
    code = "import pathlib\nHERE = pathlib.Path('{}')\ndef f(x): return x + len(str(HERE))"
    assert digest(of_user(code.format("a"))) == digest(of_user(code.format("b")))

    class Zone(tzinfo):
        pass

    assert digest(datetime(2026, 1, 1, tzinfo=Zone())) == digest(
        datetime(2026, 1, 1, tzinfo=Zone())
    )


def test_what_a_process_is_given_does_not_count(monkeypatch):
    function = of_user("from os import environ\ndef f(x): return environ.get('JOB')")
    before = digest(function)
    monkeypatch.setenv("JOB", "2")
    assert digest(function) == before


def test_sets_are_alike_in_every_process():
    code = (
        "from torchfilm.tools.hashing import digest\n"
        "class Strain:\n"
        "  def __init__(self, name): self.name = name\n"
        "STRAINS = {Strain(k // 2) for k in range(6)}\n"
        "def f(x): return x in {'a', 'bc', 'd', 'ef', 'g'} or x in STRAINS\n"
        "print(digest(f, {'a', 'bc', 'd', 'ef', 'g'}))"
    )
    found = {
        subprocess.run(
            [sys.executable, "-c", code], env={**os.environ, "PYTHONHASHSEED": seed},
            capture_output=True, text=True, check=True,
        ).stdout
        for seed in "12"
    }  # fmt: skip
    assert len(found) == 1
