"""Files in the UCF format of Cello: a JSON list of records, each in a named collection.

The format: Nielsen et al., Science 352 (2016) aac7341 (version 1); Jones et al., Nature Protocols
17 (2022) 1097 (version 2). Files are data: their equations are compared with known ones and never
evaluated.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torchfilm as tf
from torchfilm import checks

# the collections that are read; others describe the laboratory, or rules of placement
READ = (
    *("gates", "response_functions", "gate_parts", "parts"),
    *("models", "structures", "functions", "input_sensors", "output_devices"),
)
FORM = "a JSON list of records such as {'collection': 'gates', …}, as Cello writes it"


@dataclass(frozen=True)
class Record:
    """One record of a file. where: the file, the collection and the name of what it describes, for
    messages."""

    data: Mapping[str, Any]
    where: str

    def error(self, words: str) -> tf.InputError:
        return tf.InputError(f"{self.where}: {words}")

    def text(self, key: str) -> str:
        """A field that is a text."""
        return self._get(key, str, "a text, not empty")

    def entries(self, key: str) -> list[Any]:
        """A field that is a list."""
        return self._get(key, list, "a list, not empty")

    def table(self, key: str) -> Mapping[str, Any]:
        """A field with named entries."""
        return self._get(key, dict, "named entries {…}, not empty")

    def inner(self, key: str) -> list[Record]:
        """A field that is a list of records."""
        inside = self.entries(key)
        if odd := [entry for entry in inside if not isinstance(entry, dict)]:
            raise checks.input_error(f"{self.where}, {key}", odd[0], "an entry {…}")
        return [Record(entry, f"{self.where}, {key}") for entry in inside]

    def texts(self, key: str) -> list[str]:
        """A field that is a list of texts."""
        inside = self.entries(key)
        if odd := [entry for entry in inside if not isinstance(entry, str)]:
            raise checks.input_error(f"{self.where}, {key}", odd[0], "a text")
        return inside

    def numbers(self, key: str) -> dict[str, float]:
        """Numbers by name, from a list of {"name": …, "value": …}."""
        found: dict[str, float] = {}
        for entry in self.inner(key):
            name = entry.text("name")
            if name in found:
                raise self.error(f"the parameter {name!r} is given twice.")
            if "value" not in entry.data:
                raise self.error(f"the parameter {name!r} has no field 'value'.")
            found[name] = checks.number(f"{self.where}, {name}", entry.data["value"])
        return found

    def _get(self, key: str, kind: type, rule: str) -> Any:
        if key not in self.data:
            near = checks.nearest(key, self.data)
            hint = f" Did you mean {key!r} by {near!r}?" if near else ""
            raise self.error(
                f"the field {key!r} is missing.{hint} There are: {', '.join(self.data)}."
            )
        found = self.data[key]
        if not isinstance(found, kind) or not found:
            raise checks.input_error(f"{self.where}, {key}", found, rule)
        return found


class Records:
    """All records of one or more files, by collection and name."""

    def __init__(self, files: Sequence[Path]):
        self.files = ", ".join(file.name for file in files)
        self._by_collection: dict[str, dict[str, Record]] = {}
        self._unclear: dict[str, set[str]] = {}
        for file in files:
            for number, data in enumerate(_load(file)):
                self._add(file.name, number, data)

    def all(self, collection: str) -> dict[str, Record]:
        """The records of a collection by name; none where there is no such collection."""
        return self._by_collection.get(collection, {})

    def find(self, collection: str, name: str, of: Record) -> Record:
        """The record to which another one refers by its name."""
        there = self.all(collection)
        if name not in there:
            near = checks.nearest(name, there)
            hint = f" Did you mean {near!r}?" if near else ""
            raise of.error(
                f"{name!r} is not in the collection {collection!r} of {self.files}.{hint}"
            )
        if name in self._unclear.get(collection, ()):
            raise of.error(f"{name!r} is given twice in {collection!r}, and the two differ.")
        return there[name]

    def _add(self, file: str, number: int, data: Any) -> None:
        if not isinstance(data, dict) or not isinstance(data.get("collection"), str):
            raise checks.input_error(
                f"{file}, record {number}", data, f"one of {FORM}; it has no 'collection'"
            )
        collection = data["collection"]
        if collection not in READ:
            return
        there = self._by_collection.setdefault(collection, {})
        # version 1 has "gate_name" in gates and in what belongs to them
        name = next((data[k] for k in ("name", "gate_name") if isinstance(data.get(k), str)), "")
        if not name:
            raise Record(data, f"{file}, {collection}, record {number}").error("it has no 'name'.")
        what = f"{file}, {collection} {name!r}"
        # several files of one library repeat its functions and parts
        if name in there and _plain(_read(there[name].data)) != _plain(_read(data)):
            if collection == "gates":
                raise tf.InputError(f"{what} is given twice, and the two differ.")
            # a part that no gate uses does no harm
            self._unclear.setdefault(collection, set()).add(name)
        there[name] = Record(data, what)


def _read(data: Mapping[str, Any]) -> dict[str, Any]:
    """What is read of a record: variables of functions are only listed."""
    return {key: value for key, value in data.items() if key != "variables"}


def _load(file: Path) -> list[Any]:
    if not file.is_file():
        raise checks.input_error("file", str(file), "a file that exists")
    try:
        found = json.loads(file.read_text(encoding="utf-8"))
    except UnicodeDecodeError as error:
        raise tf.InputError(f"{file} is not text: {error.reason}. It must be {FORM}.") from error
    except (json.JSONDecodeError, RecursionError) as error:
        at = getattr(error, "lineno", None)
        place = f"from line {at} on " if at else ""
        raise tf.InputError(
            f"{file} cannot be read {place}({getattr(error, 'msg', error)}): it is truncated, or no"
            f" library. It must be {FORM}."
        ) from error
    if not isinstance(found, list) or not found:
        raise tf.InputError(f"{file} is no library: it must be {FORM}.")
    return found


def _plain(data: Mapping[str, Any]) -> dict[str, Any]:
    """A record without what is only a way of writing: the case of bases."""
    return {**data, "dnasequence": str(data.get("dnasequence", "")).upper()}


def same_equation(given: str, known: Iterable[str]) -> str | None:
    """The known equation that a text states, whatever its spaces; None: none of them."""
    plain = lambda text: "".join(text.split()).replace("1.0", "1")
    return next((k for k in known if plain(k) == plain(given)), None)
