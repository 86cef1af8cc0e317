"""Graphs of nodes: as data, as child processes that end together, and as actions of `ros2 launch`."""

from __future__ import annotations

import json
import math
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import MISSING, Field, dataclass, field, fields
from pathlib import Path
from types import MappingProxyType
from typing import IO, Any, TypeVar

from swarm_loc_estimator.common.command_line import command_parser, number_in
from swarm_loc_estimator.common.parameters import ParameterError, UserError, flag, number, text
from swarm_loc_estimator.common.yaml_tree import read_tree

Options = TypeVar("Options")
Choices = Mapping[str, Sequence[str]]  # Option -> the texts that it may be
NO_CHOICES: Choices = MappingProxyType({})
ParameterValue = bool | int | float | str | list[str]

GRACE_S = 5.0  # Timeout of processes after SIGINT, and again after SIGTERM
STOP_SIGNALS = {signal.SIGINT, signal.SIGTERM}
AWAITED_SIGNALS = STOP_SIGNALS | {signal.SIGCHLD}
_TIED_TO_PARENT = """
import ctypes, os, signal, sys
signal.pthread_sigmask(signal.SIG_SETMASK, {signal.SIGINT})
signal.signal(signal.SIGINT, signal.SIG_DFL)  # shells start background jobs with it ignored
PR_SET_PDEATHSIG = 1
ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGTERM)
if os.getppid() == int(sys.argv[1]):
    os.execv(sys.argv[2], sys.argv[2:])
"""
"""Runs before a program, which gets SIGINT when it asks for it; after a fork only C code is safe."""


class GraphError(UserError):
    """A graph that cannot start."""


@dataclass(frozen=True)
class GraphOptions:
    """Options of a swarm's graph."""

    swarm_file: str = field(metadata={"doc": "the swarm description"})
    bag: str | None = text(None, "play this bag into the graph, which then runs on the bag's clock")
    rate: float = number(1.0, "1", 0.01, 1000.0, "speed of the bag")
    use_sim_time: bool = flag(False, "take time from /clock without a bag")
    parameter_file: str | None = text(None, "ROS parameter file for all nodes")
    watch: bool = flag(False, "show the swarm on a page of this machine")
    watch_port: int = number(8420, "1", 0, 65535, "port of that page, 0 for any free one")


@dataclass(frozen=True)
class NodeSpec:
    """One node of a graph."""

    package: str  # Package of the executable
    executable: str  # Name of the executable
    name: str  # Name of the node
    namespace: str = ""  # Namespace of the node, "" for none
    # Parameter -> value; they override the parameter file
    parameters: Mapping[str, ParameterValue] = field(default_factory=dict)
    parameter_file: str | None = None  # Path of a ROS parameter file, None for none
    required: bool = True  # Whether the graph ends when this node ends

    @property
    def full_name(self) -> str:
        """Name with the namespace before it, unique in a graph."""
        return f"{self.namespace}/{self.name}" if self.namespace else self.name

    def ros_arguments(self) -> list[str]:
        """The command-line arguments that configure the executable as this node."""
        arguments = ["--ros-args", "-r", f"__node:={self.name}"]
        if self.namespace:
            arguments += ["-r", f"__ns:=/{self.namespace}"]
        if self.parameter_file is not None:
            arguments += ["--params-file", self.parameter_file]
        for name, value in self.parameters.items():
            arguments += ["-p", f"{name}:={json.dumps(value)}"]
        return arguments


@dataclass(frozen=True)
class Child:
    """A process of a graph."""

    spec: NodeSpec
    process: subprocess.Popen[bytes]


def graph_nodes(options: GraphOptions) -> list[NodeSpec]:
    """The nodes of a swarm's graph in the order of their start: estimator, player and page if requested."""

    def node(executable: str, name: str, parameters: dict[str, ParameterValue]) -> NodeSpec:
        file, required = options.parameter_file, name != "watch"
        return NodeSpec("swarm_loc_estimator", executable, name, "", parameters, file, required=required)

    on_sim_time = options.use_sim_time or options.bag is not None
    common: dict[str, ParameterValue] = {"swarm_file": options.swarm_file, "use_sim_time": on_sim_time}
    nodes = [node("estimator_node", "estimator", common)]
    if options.bag is not None:
        # the estimator starts more slowly than the player, which therefore waits for a subscriber
        play: dict[str, ParameterValue] = {"bag": options.bag, "rate": options.rate}
        nodes.append(node("play", "player", {**play, "wait_for_subscribers": 1}))
    if options.watch:
        nodes.append(node("watch_node", "watch", {**common, "port": options.watch_port}))
    return nodes


def parsed_options(
    kind: type[Options],
    description: str | None,
    arguments: Sequence[str] | None,
    choices: Choices = NO_CHOICES,
) -> Options:
    """A dataclass of options from a command line; some texts must be among `choices`."""
    parser = command_parser(description)
    for one in fields(kind):  # type: ignore[arg-type]  # any dataclass
        default: Any = one.default
        spec, said = one.metadata.get("spec"), _doc(one)
        flags = f"--{_argument(one)}".replace("_", "-")
        if default is MISSING:
            parser.add_argument(one.name, metavar=one.name.upper(), help=said)
        elif isinstance(default, bool):
            parser.add_argument(flags, dest=one.name, action="store_true", help=said)
        else:
            kind_of = type(default)
            read = number_in(kind_of(spec.low), kind_of(spec.high), spec.unit.strip("1")) if spec else str
            said += f" (default: {default})" if default else ""
            allowed = choices.get(one.name)
            parser.add_argument(flags, dest=one.name, type=read, default=default, choices=allowed, help=said)
    return kind(**vars(parser.parse_args(arguments)))


def launch_arguments(kind: type, choices: Choices = NO_CHOICES) -> list[Any]:
    """The same options as actions of `launch` that declare its arguments."""
    from launch.actions import DeclareLaunchArgument  # noqa: PLC0415 - `graph` works without launch

    declared = []
    for one in fields(kind):
        about: dict[str, Any] = {"description": _doc(one)}
        if one.default is not MISSING:
            about["default_value"] = "" if one.default is None else str(one.default)
        if one.name in choices:
            about["choices"] = ["", *choices[one.name]]
        if isinstance(one.default, bool):
            about |= {"default_value": str(one.default).lower(), "choices": ["true", "false"]}
        declared.append(DeclareLaunchArgument(_argument(one), **about))
    return declared


def _argument(option: Field[Any]) -> str:
    return {"parameter_file": "params_file"}.get(option.name, option.name)


def _doc(option: Field[Any]) -> str:
    spec = option.metadata.get("spec")
    return str(spec.doc if spec else option.metadata["doc"])


def options_from(kind: type[Options], texts: Mapping[str, str]) -> Options:
    """A dataclass of options from texts of a `launch.LaunchContext`, "": default; raises ParameterError."""
    return kind(**{one.name: _value(one, texts.get(_argument(one), "")) for one in fields(kind)})  # type: ignore[arg-type]


def _value(option: Field[Any], text: str) -> object:
    default: Any = option.default
    if not text:
        if default is MISSING:
            raise ParameterError(f"argument {option.name} is not set.")
        return default
    if "spec" not in option.metadata:
        return text == "true" if isinstance(default, bool) else text
    try:
        value = type(default)(text)
    except ValueError:
        value = math.nan
    spec = option.metadata["spec"]
    if not spec.allows(value):
        kind = "whole number" if isinstance(default, int) else "number"
        raise ParameterError(f"argument {option.name} = '{text}' must be a {kind} in {spec.range_text}.")
    return value


def check_parameter_file(path: str | None) -> None:
    """Raise UserError if a file is given that cannot be read or has no ROS parameters."""
    if path is not None and not _has_parameters(read_tree(Path(path))):
        raise ParameterError(f"argument params_file = '{path}' has no ros__parameters.")


def _has_parameters(tree: object) -> bool:
    return isinstance(tree, dict) and ("ros__parameters" in tree or any(map(_has_parameters, tree.values())))


def node_action(spec: NodeSpec) -> Any:
    """The `launch_ros.actions.Node` of a node; needs launch_ros, which a full ROS 2 installation has."""
    from launch.actions import Shutdown  # noqa: PLC0415 - `graph` works without launch_ros
    from launch_ros.actions import Node  # noqa: PLC0415 - see above

    files = [] if spec.parameter_file is None else [spec.parameter_file]
    return Node(
        package=spec.package,
        executable=spec.executable,
        name=spec.name,
        namespace=spec.namespace,
        parameters=[*files, dict(spec.parameters)],
        output="screen",
        on_exit=[Shutdown(reason=f"{spec.full_name} ended")] if spec.required else [],
    )


def executable_path(package: str, executable: str) -> Path:
    """Path of a package's executable; raises GraphError if the package or the executable is missing."""
    from ament_index_python.packages import (  # noqa: PLC0415 - graphs can be described without ROS
        PackageNotFoundError,
        get_package_prefix,
    )

    try:
        path = Path(get_package_prefix(package), "lib", package, executable)
    except PackageNotFoundError as error:
        raise GraphError(f"There is no package '{package}' in this environment.") from error
    if not os.access(path, os.X_OK):
        raise GraphError(f"There is no executable '{executable}' in package '{package}'.")
    return path


def node_command(node: NodeSpec) -> list[str]:
    """Program and arguments of a node; raises GraphError if the executable is missing."""
    return [str(executable_path(node.package, node.executable)), *node.ros_arguments()]


def print_line(line: str) -> None:
    """Print a line in one piece, since the nodes print to the same terminal."""
    print(f"[graph] {line}\n", end="", flush=True)


def run_graph(nodes: Sequence[NodeSpec], say: Callable[[str], None] = print_line) -> int:
    """Run nodes, in their order, until a required one ends or this process gets SIGINT or SIGTERM; end all.

    `say` gets each line for the user. Returns 0 after a signal, else the status of the required node that
    ended (128 + n after signal n). Raises GraphError if an executable is missing; then nothing was started.
    """
    commands = [node_command(node) for node in nodes]
    previous = signal.pthread_sigmask(signal.SIG_BLOCK, AWAITED_SIGNALS)
    children: list[Child] = []
    try:
        for node, command in zip(nodes, commands, strict=True):
            children.append(Child(node, start(command)))
            say(f"{node.full_name}: started as process {children[-1].process.pid}")
        return _watch(children, say)
    finally:
        stop(children, say)
        signal.pthread_sigmask(signal.SIG_SETMASK, previous)


def start(command: Sequence[str], output: IO[bytes] | None = None) -> subprocess.Popen[bytes]:
    """Start a process, with its output, out of reach of a terminal's Ctrl-C, that dies with this one."""
    return subprocess.Popen(
        [sys.executable, "-S", "-c", _TIED_TO_PARENT, str(os.getpid()), *command],
        stdout=output,
        stderr=output,
        start_new_session=True,
    )


def _watch(children: Sequence[Child], say: Callable[[str], None]) -> int:
    """Wait until a required process ends or a signal asks to stop."""
    running = list(children)
    while True:
        for child in [c for c in running if c.process.poll() is not None]:
            running.remove(child)
            code = child.process.returncode
            status = 128 - code if code < 0 else code  # as shells count
            say(f"{child.spec.full_name}: ended with status {status}")
            if child.spec.required or not running:
                return status
        received = signal.sigwait(AWAITED_SIGNALS)
        if received in STOP_SIGNALS:
            say(f"stopping on {signal.Signals(received).name}")
            return 0


def stop(children: Sequence[Child], say: Callable[[str], None]) -> None:
    """End the processes that still run: by SIGINT, then SIGTERM, then SIGKILL."""
    for stop_signal, patience_s in (
        (signal.SIGINT, GRACE_S),
        (signal.SIGTERM, GRACE_S),
        (signal.SIGKILL, None),
    ):
        running = [child for child in children if child.process.poll() is None]
        for child in running:
            if stop_signal != signal.SIGINT:
                say(f"{child.spec.full_name}: does not end, {stop_signal.name}")
            child.process.send_signal(stop_signal)
        end_s = math.inf if patience_s is None else time.monotonic() + patience_s
        for child in running:
            with suppress(subprocess.TimeoutExpired):
                child.process.wait(None if patience_s is None else max(0.0, end_s - time.monotonic()))
