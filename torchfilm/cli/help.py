"""The command `torchfilm help NAME`: signature and docstring of a public name, as text."""

from __future__ import annotations

import inspect
from collections.abc import Iterator
from dataclasses import dataclass
from importlib import import_module
from types import ModuleType, UnionType
from typing import Annotated, Any

import tyro

from torchfilm.tools import checks

PACKAGES = ("torchfilm", "design")
PREFIX = {"torchfilm": "tf.", "design": "design."}
WIDTH = 100


@dataclass
class Help:
    """Print the signature and the docstring of a public name, and its methods; without a name, list
    all public names. For a command, such as export, see `torchfilm export --help`."""

    name: Annotated[str, tyro.conf.Positional] = ""
    """Such as Growth, tf.Circuit.from_sbml, parts.repressed or design.Stripe."""

    def __call__(self) -> None:
        print(describe(self.name) if self.name else listing())


def listing() -> str:
    """All public names, each with the first sentence of its docstring."""
    lines = []
    for package in PACKAGES:
        module = import_module(package)
        lines += [f"{package}: {_first(module)}"]
        lines += [_line(PREFIX[package] + n, thing) for n, thing in _members(module)]
    return "\n".join(lines)


def describe(name: str) -> str:
    """Signature, docstring and members of a public name; "tf." or "design." may be left out. Raises
    InputError for a name that is not public."""
    title, thing = _find(name)
    if title in PACKAGES:
        lines = [title]
    elif isinstance(thing, property):
        lines = [f"{title}: property"]
    else:
        lines = [_signature(title, thing)]
    lines += [_about(thing)]
    public = _public_bases(thing)
    known = {n for base in public.values() for n, _ in _members(base)}
    members = [_line(f"{title}.{n}", m) for n, m in _members(thing) if n not in known]
    if members:
        lines += ["", *members]
    if public:
        lines += ["", f"It also has the methods of {', '.join(public)}."]
    return "\n".join(lines).rstrip()


def _find(name: str) -> tuple[str, Any]:
    """The full title and the object of a name as a user may type it."""
    first, *rest = name.removesuffix("()").split(".")
    if first in ("tf", *PACKAGES):
        packages = ["torchfilm" if first == "tf" else first]
    else:
        packages, rest = list(PACKAGES), [first, *rest]
    known = [PREFIX[p] + n for p in PACKAGES for n, _ in _members(import_module(p))]
    for package in packages:
        thing: Any = import_module(package)
        if not rest:
            return package, thing
        for depth, word in enumerate(rest):
            members = dict(_members(thing))
            if word not in members:
                start = PREFIX[package] + "".join(f"{w}." for w in rest[:depth])
                known += [start + n for n in members]
                break
            thing = members[word]
        else:
            return PREFIX[package] + ".".join(rest), thing
    inside = dict(_members_inside()) if len(rest) == 1 else {}
    meant = [n for n in inside if n.split(".")[-1] == rest[-1]]
    if len(meant) == 1:
        return meant[0], inside[meant[0]]
    last: dict[str, list[str]] = {}
    for title in dict.fromkeys((*inside, *known)):
        last.setdefault(title.split(".")[-1].lower(), []).append(title)
    near = checks.nearest(rest[-1].lower(), last)
    *others, one = meant or (last[near] if near else [""])
    hint = f"Did you mean {', '.join(others) + ' or ' if others else ''}{one}?"
    hint = hint if one else "`torchfilm help` lists them."
    raise checks.input_error("name", name, "a public name of torchfilm or design", hint)


def _members_inside() -> Iterator[tuple[str, Any]]:
    """The members of public classes and modules by their titles; a method that a class has from a
    public base is named there only."""
    for package in PACKAGES:
        for name, thing in _members(import_module(package)):
            of_bases = {n for base in _public_bases(thing).values() for n, _ in _members(base)}
            for own, member in _members(thing):
                if own not in of_bases:
                    yield f"{PREFIX[package]}{name}.{own}", member


def _members(thing: Any) -> Iterator[tuple[str, Any]]:
    """The public members of a module, or those that a class and its bases of ours define."""
    if isinstance(thing, ModuleType):
        own = thing.__name__
        defined = [n for n, v in vars(thing).items() if getattr(v, "__module__", "") == own]
        for name in getattr(thing, "__all__", defined):
            if not name.startswith("_"):
                yield name, getattr(thing, name)
    elif inspect.isclass(thing):
        seen = set()
        for base in thing.__mro__:
            if base.__module__.split(".")[0] not in PACKAGES:
                continue
            for name, member in vars(base).items():
                if isinstance(member, (staticmethod, classmethod)):
                    member = getattr(thing, name)
                shown = callable(member) or isinstance(member, property)
                if shown and not name.startswith("_") and name not in seen:
                    seen.add(name)
                    yield name, member


def _public_bases(thing: Any) -> dict[str, Any]:
    """The public classes that a class is made from, by their titles."""
    bases = thing.__mro__[1:] if inspect.isclass(thing) else ()
    return {
        PREFIX[package] + name: member
        for package in PACKAGES
        for name, member in _members(import_module(package))
        if any(member is base for base in bases)
    }


def _signature(title: str, thing: Any) -> str:
    """The call of a function or a class; a line for each argument where it is long."""
    if not callable(thing):
        return title
    try:
        found = inspect.signature(thing)
    except (TypeError, ValueError):
        return title
    arguments: list[str] = []
    star = False
    for name, argument in found.parameters.items():
        star |= argument.kind is argument.VAR_POSITIONAL
        if argument.kind is argument.KEYWORD_ONLY and not star:
            arguments, star = [*arguments, "*"], True
        if name != "self":
            hidden = " at 0x" in repr(argument.default)  # an object without a text of its own
            default = _Plain("…") if hidden else argument.default
            annotation = _Plain.of(argument.annotation)
            arguments.append(str(argument.replace(annotation=annotation, default=default)))
    back = ""
    if not inspect.isclass(thing) and found.return_annotation is not found.empty:
        back = f" -> {_Plain.of(found.return_annotation)!r}"
    text = f"{title}({', '.join(arguments)}){back}"
    if len(text) <= WIDTH:
        return text
    return "\n".join([f"{title}(", *(f"    {a}," for a in arguments), f"){back}"])


class _Plain(str):
    """An annotation as it stands in the code, without quotes."""

    def __repr__(self) -> str:
        return str(self)

    @classmethod
    def of(cls, annotation: Any) -> Any:
        return cls(annotation) if isinstance(annotation, str) else annotation


def _first(thing: Any) -> str:
    """The first sentence of a docstring, on one line; of a number or a table, nothing."""
    documented = callable(thing) or isinstance(thing, (ModuleType, property, UnionType))
    doc = _about(thing) if documented else ""
    paragraph = " ".join(doc.split("\n\n")[0].split())
    open_brackets = 0
    for k, letter in enumerate(paragraph):
        open_brackets += (letter == "(") - (letter == ")")
        if not open_brackets and paragraph[k : k + 2] == ". ":  # not that of (Fig. 5)
            return paragraph[:k]
    return paragraph.removesuffix(".")


def _about(thing: Any) -> str:
    """A docstring; of a type for annotations, what it may be."""
    if isinstance(thing, UnionType):
        return f"A type, for annotations of your own.\n\n{thing}"
    return inspect.getdoc(thing) or ""


def _line(title: str, thing: Any) -> str:
    return f"  {title}  {_first(thing)}".rstrip()
