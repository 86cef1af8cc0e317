"""Shared parts of all commands: entry point, exit status, common arguments, progress bar."""

from __future__ import annotations

import argparse
import os
import re
import signal
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import wraps
from importlib import import_module
from pathlib import Path
from types import MappingProxyType
from typing import Any, ParamSpec, Protocol, TextIO, TypeVar

from typing_extensions import Self

from swarm_loc_estimator.common.files import check_folder
from swarm_loc_estimator.common.parameters import (
    ParameterError,
    UserError,
    Value,
    from_values,
    parameter_specs,
)

Arguments = ParamSpec("Arguments")
Parameters = TypeVar("Parameters")
Number = TypeVar("Number", int, float)

_INTERRUPTED = 130  # Exit status of a program that SIGINT has ended, as shells count
_REDRAW_S = 0.1
_WIDTH = 30
_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_]*")
_ROS = ("ament_index_python", "launch", "launch_ros", "rclpy")
_FOR_BAGS = ("lz4", "mcap", "rosbags", "zstandard")
"""Only for bags; rosdep knows no packages of them but by pip, so package.xml does not name them."""


@dataclass(frozen=True)
class Program:
    """An entry point that imports a module only when it is called, and then runs its function.

    SIGINT, and SIGTERM during the import, end it at once with status 128 + n: an exception might be swallowed
    where a compiler has called back. A missing package of others is one sentence and status 1.
    """

    module: str  # Full name of the module
    function: str = "main"  # The one to run
    needs_ros: bool = False  # Whether it runs only with ROS 2

    def __call__(self) -> int:
        """Run the program; returns its exit status."""
        signal.signal(signal.SIGINT, _leave)
        before = signal.signal(signal.SIGTERM, _leave)
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})  # see `launch.start`
        try:
            main: Callable[[], int] = getattr(import_module(self.module), self.function)
            signal.signal(signal.SIGTERM, before)
            status = main()
        except ModuleNotFoundError as error:
            missing = (error.name or "").partition(".")[0]
            if missing == self.module.partition(".")[0]:
                raise
            advice = f": pip install {' '.join(_FOR_BAGS)}" if missing in _FOR_BAGS else ""
            need = f"the Python package {missing}, which is not installed{advice}"
            if missing in _ROS or missing.endswith("_msgs"):
                need = f"ROS 2 and this workspace, built and sourced: there is no Python package {missing}"
            print(f"{Path(sys.argv[0]).name} needs {need}.", file=sys.stderr)
            return 1
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # all is done, and Python's end gives up handlers
        return status


def _leave(number: int, _frame: object) -> None:
    os.write(2, f"Stopped by {signal.Signals(number).name}.\n".encode())
    os._exit(128 + number)


def exit_with_message(main: Callable[Arguments, int]) -> Callable[Arguments, int]:
    """Decorate the `main` of a command: a `UserError` ends it with one sentence and status 1."""

    @wraps(main)
    def wrapped(*args: Arguments.args, **kwargs: Arguments.kwargs) -> int:
        try:
            return main(*args, **kwargs)
        except UserError as error:
            message = str(error)
        except OSError as error:
            message = f"{error.filename or 'A file'} cannot be used: {error.strerror or error}."
        except KeyboardInterrupt:
            return _INTERRUPTED
        print(message, file=sys.stderr)
        return 1

    return wrapped


def command_parser(description: str | None) -> argparse.ArgumentParser:
    """The parser of a command, whose description keeps its line breaks."""
    formatter = argparse.RawDescriptionHelpFormatter
    return argparse.ArgumentParser(description=description, formatter_class=formatter)


Add = Callable[[argparse.ArgumentParser], object]  # Adds options to a parser


class EntryPoint(Protocol):
    """A command as it is called."""

    def __call__(self, arguments: Sequence[str] | None = None) -> int:
        """Run it, by default with the command line; returns the exit status."""


def command(
    description: str | None, *add: Add
) -> Callable[[Callable[[argparse.Namespace], int]], EntryPoint]:
    """Decorate the `main` of a command, which gets the options that `add` has put into its parser."""

    def decorated(main: Callable[[argparse.Namespace], int]) -> EntryPoint:
        @exit_with_message
        def run(arguments: Sequence[str] | None = None) -> int:
            parser = command_parser(description)
            for one in add:
                one(parser)
            return main(parser.parse_args(arguments))

        return run

    return decorated


def argument(*names: str, **about: Any) -> Add:
    """An argument of a command, as `add_argument` of a parser has it."""
    return lambda parser: parser.add_argument(*names, **about)


def number_in(low: Number, high: Number, unit: str = "") -> Callable[[str], Number]:
    """A type for argparse: a number within limits, of the type of these limits."""

    def read(text: str) -> Number:
        try:
            value = type(low)(text)
        except ValueError:
            value = None
        if value is None or not low <= value <= high:
            what = f"a number in [{low:g}, {high:g}]{unit and ' '}{unit}"
            raise argparse.ArgumentTypeError(f"{text} must be {what}")
        return value

    return read


def folder_to_write(*patterns: str) -> Callable[[str], Path]:
    """A type for argparse: a folder whose files of these patterns can be written, see `check_folder`."""

    def read(text: str) -> Path:
        try:
            check_folder(Path(text), *patterns)
        except UserError as error:
            raise argparse.ArgumentTypeError(str(error).rstrip(".")) from error
        return Path(text)

    return read


def bag_to_write(text: str) -> Path:
    """A type for argparse: a bag that does not exist, in a folder that can be written."""
    path = Path(text)
    if os.path.lexists(path):
        raise argparse.ArgumentTypeError(f"{path} exists already")
    return folder_to_write()(str(path.parent)) / path.name


def file_to_write(*suffixes: str, picture: str = "") -> Callable[[str], Path]:
    """A type for argparse: a file of these suffixes that can be written, as can a `picture` of its name."""

    def read(text: str) -> Path:
        path = Path(text)
        if path.suffix not in suffixes:
            raise argparse.ArgumentTypeError(f"'{text}' must end in {' or '.join(suffixes)}")
        folder_to_write(path.name, path.with_suffix(picture or path.suffix).name)(str(path.parent))
        return path

    return read


yaml_to_write = file_to_write(".yaml", ".yml")
yaml_and_picture = file_to_write(".yaml", ".yml", picture=".png")


def add_bag(parser: argparse.ArgumentParser, content: str = "", *, several: bool = False) -> None:
    """Add the arguments of a command that reads a bag, or several: the bag, and its swarm description."""
    nargs = "+" if several else None
    parser.add_argument("bag", type=Path, nargs=nargs, help=f"rosbag2 folder, .mcap or .db3 file{content}")
    parser.add_argument("--swarm", type=Path, help="swarm description (default: swarm.yaml next to the bag)")


def add_remap(parser: argparse.ArgumentParser) -> None:
    """Add `--remap EXPECTED:=TOPIC`, which may be given several times; the options hold a dictionary."""

    class Remap(argparse.Action):
        def __call__(self, parser: argparse.ArgumentParser, options: Any, value: Any, *_: object) -> None:
            own, separator, stored = value.partition(":=")
            if not (own and separator and stored):
                parser.error(f"argument --remap: '{value}' must be EXPECTED:=TOPIC")
            options.remap = {**options.remap, own: stored}

    said = "topic of the bag to read in place of an expected one, such as '<robot>/odom:=<robot>/odometry'"
    parser.add_argument("--remap", action=Remap, default={}, metavar="EXPECTED:=TOPIC", help=said)


def add_truth(parser: argparse.ArgumentParser) -> None:
    """Add `--truth FOLDER`, of `tum.read_truth`."""
    said = "folder of <robot>.truth.tum in place of the bag's ground truth"
    parser.add_argument("--truth", type=Path, metavar="FOLDER", help=said)


_DESCRIPTIONS = (".yaml", ".yml")


def add_live_or_bag(parser: argparse.ArgumentParser, seconds: str) -> None:
    """Add the arguments of a command for a live graph or a bag, see `is_live`; `seconds` is help of one."""
    parser.add_argument("source", metavar="SWARM_FILE|BAG", type=Path, help="swarm description, or a bag")
    parser.add_argument("--swarm", type=Path, help="swarm description (default: swarm.yaml next to the bag)")
    parser.add_argument("--seconds", type=number_in(1.0, 3600.0, "s"), help=seconds)
    parser.add_argument("--namespace", default="", help="namespace of the whole swarm, such as lab")
    parser.add_argument("--use-sim-time", action="store_true", help="take time from /clock")
    add_remap(parser)


def is_live(options: argparse.Namespace) -> bool:
    """Whether the source is a description: a live graph; raises UserError if options do not fit it."""
    live = is_description(options.source)
    if live and options.remap:
        raise UserError("--remap is for bags; remap topics of a live graph in their nodes.")
    if options.use_sim_time and not live:
        raise UserError("--use-sim-time is for a live graph; a bag has its own time.")
    names = options.namespace.strip("/").split("/")
    if options.namespace and not all(map(_NAME.fullmatch, names)):
        raise UserError(f"--namespace '{options.namespace}' must be names with slashes between, such as lab.")
    return live


def described(options: argparse.Namespace) -> Path:
    """Path of the swarm description: --swarm, the source itself, or the one next to the bag."""
    live = is_description(options.source)
    return options.swarm or (options.source if live else swarm_beside(options.source))


def is_description(source: Path) -> bool:
    """Whether a path is that of a description; a folder of any name is a bag."""
    return source.suffix in _DESCRIPTIONS and not source.is_dir()


def swarm_beside(bag: Path) -> Path:
    """Path of the swarm description next to a bag; raises UserError if there is no bag."""
    if not bag.exists():
        raise UserError(f"There is no bag '{bag}'.")
    return (bag if bag.is_dir() else bag.parent) / "swarm.yaml"


def add_set(parser: argparse.ArgumentParser, what: str) -> None:
    """Add `--set NAME=VALUE`, which may be given several times; see `parameters_of`."""
    parser.add_argument("--set", action="append", default=[], metavar="NAME=VALUE", help=what)


def parameters_of(
    cls: type[Parameters], pairs: Sequence[str], given: Mapping[str, Value] = MappingProxyType({})
) -> Parameters:
    """A dataclass of parameters from texts such as `horizon_s=1.0`, with defaults for the others.

    Users cannot set what is `given` by name. Raises ParameterError if a value cannot be used.
    """
    specs = {spec.name: spec for spec in parameter_specs(cls)}
    values = {name: spec.default for name, spec in specs.items()} | {**given}
    for pair in pairs:
        name, _, text = pair.partition("=")
        if name not in specs or name in given:
            known = ", ".join(name for name in specs if name not in given)
            raise ParameterError(f"--set {pair}: '{name}' is no parameter; there are {known}.")
        value: object = text
        default = specs[name].default  # a text that cannot be converted is refused below
        with suppress(ValueError):
            if isinstance(default, tuple):
                value = [part for part in text.split(",") if part]
            elif isinstance(default, bool):
                value = {"true": True, "false": False}.get(text, text)
            else:
                value = type(default)(text)
        values[name] = specs[name].checked(value)
    return from_values(cls, values)


class ProgressLine:
    """A progress bar in one line of a terminal, by default standard error, cleared at the end; else none."""

    def __init__(self, stream: TextIO | None = None) -> None:
        self._stream = sys.stderr if stream is None else stream
        self._shown = self._stream.isatty()
        self._last = 0.0

    def __call__(self, share: float, what: str) -> None:
        """Show the share done, 0 to 1, and what is being done."""
        now = time.monotonic()
        if not self._shown or (share < 1.0 and now - self._last < _REDRAW_S):
            return
        self._last = now
        bar = "#" * round(_WIDTH * share)
        self._stream.write(f"\r[{bar:<{_WIDTH}}] {share:4.0%} {what}\x1b[K")
        self._stream.flush()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        if self._shown:
            self._stream.write("\r\x1b[K")
            self._stream.flush()
