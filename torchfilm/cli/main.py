"""The entry point of the command line: `torchfilm run SCENE`, `resume FILE`, `show FILE`,
`export FILE OUT`, `info SCENE-or-FILE`, `explain SCENE`, `tune SCENE`, `help NAME`."""

from __future__ import annotations

import dataclasses
import io
import os
import signal
import sys
import warnings
from typing import Any

from torchfilm.tools.checks import InputError, SimulationError, install, unknown_keyword
from torchfilm.tools.memory import keep_memory
from torchfilm.tools.warn_once import once
from torchfilm.version import __version__

try:
    import tyro

    from torchfilm.cli.export import Export
    from torchfilm.cli.help import Help
    from torchfilm.cli.inspect import Explain, Info, Tune
    from torchfilm.cli.run import Resume, Run
    from torchfilm.cli.show import Show
except ImportError as missing:  # pragma: no cover - depends on what is installed
    raise SystemExit(f"The command line needs {missing.name}: {install('app')}.") from missing

COMMANDS: dict[str, type[Any]] = {
    "run": Run,
    "resume": Resume,
    "show": Show,
    "export": Export,
    "info": Info,
    "explain": Explain,
    "tune": Tune,
    "help": Help,
}

UNREADABLE = 2  # the exit code for a line that cannot be read, as the parser's own


def main() -> None:
    """Entry point of the `torchfilm` command."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")  # a terminal that knows no µ
    try:
        try:
            _command()
        finally:
            # raises here, and not at the interpreter's end, if the reader is gone (`| head -1`)
            sys.stdout.flush()
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        raise SystemExit(1) from None


def _command() -> None:
    if sys.argv[1:] == ["--version"]:
        print(f"torchfilm {__version__}")
        return
    try:
        check_options(sys.argv[1:])
    except InputError as error:
        print(f"torchfilm: {error}", file=sys.stderr)
        raise SystemExit(UNREADABLE) from None
    command = tyro.extras.subcommand_cli_from_dict(
        {**COMMANDS},
        prog="torchfilm",
        description="Synthetic microbial biofilms, many colonies at once. --version: this one's.",
        args=gather_repeated(sys.argv[1:]),
    )
    keep_memory()
    line_format, warnings.formatwarning = warnings.formatwarning, _format_warning
    try:
        with once():
            command()
    except (InputError, SimulationError) as error:
        words = str(error).replace('on_failure="drop"', "--on-failure drop")
        raise SystemExit(f"torchfilm: {words}") from None
    except KeyboardInterrupt as stop:
        safe = (
            "; the recorded frames are safe, `torchfilm resume` resumes the run"
            if isinstance(command, (Run, Resume))
            else ""
        )
        print(f"stopped{safe}.", file=sys.stderr)
        # as shells count processes that a signal has ended
        number = stop.args[0] if stop.args and isinstance(stop.args[0], int) else signal.SIGINT
        raise SystemExit(128 + number) from None
    finally:
        warnings.formatwarning = line_format


def _format_warning(message: Warning | str, *_: object, **__: object) -> str:
    """A warning without the line of code that raised it, which is not the user's."""
    return f"warning: {message}\n"


def check_options(args: list[str]) -> None:
    """Raise InputError for an option that a command does not have, with the nearest one. The parser
    would list those of all commands."""
    command = COMMANDS.get(args[0]) if args else None
    if command is None:
        return
    fields = [f for f in _options(command) if "Positional" not in str(f.type)]
    known = {f"--{f.name.replace('_', '-')}": str(f.type) for f in fields}
    off = {f"--no-{name[2:]}" for name, kind in known.items() if kind == "bool"}
    seen = set()
    for arg in args[1:]:
        name = arg.partition("=")[0].replace("_", "-")
        if name in seen and not known[name].startswith("list"):
            raise InputError(f"the option {name} is given twice: keep one.")
        seen |= {name} & {*known}
        if arg.startswith("--") and name not in (*known, *off, "--help"):
            raise unknown_keyword(args[0], arg.partition("=")[0], list(known))


def _options(command: type) -> list[dataclasses.Field[Any]]:
    """The fields of a command, with those of its groups of options."""
    found = []
    for known in dataclasses.fields(command):
        group = known.default_factory
        found += _options(group) if dataclasses.is_dataclass(group) else [known]
    return found


def gather_repeated(args: list[str]) -> list[str]:
    """Collect the values of list options that are given several times. The parser would keep only
    the last of `--set a=1 --set b=2`."""
    command = COMMANDS.get(args[0]) if args else None
    several = (
        {f"--{f.name}" for f in dataclasses.fields(command) if str(f.type).startswith("list")}
        if command
        else set()
    )
    if not any(sum(a.partition("=")[0] == name for a in args) > 1 for name in several):
        return args
    gathered: dict[str, list[str]] = {}
    into: list[str] = []
    out = [into]  # each option with its values
    for arg in args:
        name, equals, value = arg.partition("=")
        if name in several:
            if name not in gathered:
                out.append(gathered.setdefault(name, [name]))
            into = gathered[name]
            into += [value] if equals else []
            continue
        if arg.startswith("--"):
            into = []
            out.append(into)
        into.append(arg)
    return [word for words in out for word in words]


if __name__ == "__main__":
    main()
