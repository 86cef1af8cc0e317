"""Write a first description of a swarm, from a few answers or from what it publishes.

    new                                                                       # asks on the terminal
    new epucks.yaml --yes --type epuck2 --robots 5 --arena 2.4x1.6            # asks nothing
    new recording.mcap swarm.yaml                                             # from a bag
    new --live swarm.yaml                                                     # from the running graph

From a bag or the running graph it takes robots, topics, mounts, clocks, radios, maps and, where there is
ground truth, starts and places. What must be written by hand stands in comments with "# ?".

Options answer questions in advance; --yes takes the default for all others. Marker ids are given so that none
appears twice. A JSON Schema is written to the same folder, with which editors complete it.
"""

from __future__ import annotations

import argparse
import shlex
import sys
import textwrap
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from typing import Any, TypeVar

from swarm_loc_estimator.common.codec import Tree
from swarm_loc_estimator.common.command_line import (
    ProgressLine,
    argument,
    command,
    is_description,
    number_in,
)
from swarm_loc_estimator.common.files import write_whole
from swarm_loc_estimator.common.parameters import UserError
from swarm_loc_estimator.common.yaml_tree import write_tree
from swarm_loc_estimator.swarm.new_swarm import FAMILY_IDS, KNOWN_ROBOTS, SENSORS, SwarmPlan, planned_swarm
from swarm_loc_estimator.swarm.schema import schema_text
from swarm_loc_estimator.swarm.swarm import Swarm
from swarm_loc_estimator.swarm.swarm_file import MAX_NAME, MAX_ROBOTS, NAME, SCHEMA_FILE, save_swarm

Answer = TypeVar("Answer")
QUESTIONS = {
    "type": f"type of the robots: {', '.join(KNOWN_ROBOTS)}",
    "robots": "number of robots",
    "prefix": "names of the robots begin with",
    "sensors": "what locates them, with commas between",
    "wheel-separation": "distance between the wheels [m]",
    "family": f"kind of markers: {', '.join(FAMILY_IDS)}",
    "size": "side of the markers on robots, black border included [m]",
    "arena": "length along x and along y [m], such as 2.4x1.6",
    "pitch": "distance of landmarks along the walls [m]",
    "landmark-size": "side of the landmarks [m]",
    "map": "the map's .yaml file, as of map_server",
}
_LENGTH = number_in(0.001, 10.0, "m")
_LIVE_S = 10.0  # How long to listen


class Dialog:
    """Takes each answer from an option, from the defaults, or from the terminal, until it can be used."""

    def __init__(self, given: Mapping[str, str], *, asks: bool) -> None:
        self._given, self._asks = dict(given), asks

    @property
    def unused(self) -> list[str]:
        """Names of options that no question has used."""
        return list(self._given)

    def answer(self, name: str, default: str, read: Callable[[str], Answer], choice: str = "") -> Answer:
        """The answer to the question `name` of `QUESTIONS`, which `choice` explains; Enter takes the default.

        `read` converts an answer, and raises ArgumentTypeError with what is allowed. Raises UserError if an
        option cannot be used, or standard input has ended.
        """
        text = self._given.pop(name, None)
        if text is not None or not self._asks:
            try:
                return read(default if text is None else text)
            except argparse.ArgumentTypeError as error:
                raise UserError(f"--{name}: {error}.") from error
        while True:
            try:
                text = input(f"{QUESTIONS[name]}{choice} [{default}]: ").strip()
            except EOFError:
                raise UserError(
                    "There are no more answers on standard input; --yes takes the defaults."
                ) from None
            try:
                return read(text or default)
            except argparse.ArgumentTypeError as error:
                print(f"{error}.")


def asked_plan(dialog: Dialog) -> SwarmPlan:
    """The plan of a swarm by the answers of a user."""
    name = dialog.answer("type", "epuck", _one_of(KNOWN_ROBOTS))
    known = KNOWN_ROBOTS[name]
    usual = SwarmPlan(name, 5, "robot" if name == "own" else name, known.usual_sensors)
    robots = dialog.answer("robots", str(usual.robots), number_in(1, MAX_ROBOTS))
    first = f"{usual.prefix}_" if usual.prefix[-1].isdigit() else usual.prefix
    prefix = dialog.answer("prefix", first, _prefix)
    choice = "".join(f"\n  {sensor}: {SENSORS[sensor]}" for sensor in known.sensors)
    sensors = dialog.answer("sensors", ",".join(known.usual_sensors), _some_of(known.sensors), choice)
    plan = replace(usual, robots=robots, prefix=prefix, sensors=sensors)
    if name == "own" and known.odometry:
        wheels = dialog.answer("wheel-separation", f"{known.odometry.wheel_separation:g}", _LENGTH)
        plan = replace(plan, wheel_separation=wheels)
    if {"robots", "landmarks", "aerial", "ceiling"} & set(sensors):
        plan = replace(plan, family=dialog.answer("family", plan.family, _one_of(FAMILY_IDS)))
    if {"robots", "ceiling"} & set(sensors):
        plan = replace(plan, size=dialog.answer("size", f"{known.marker_size:g}", _LENGTH))
    if "map" in sensors:
        plan = replace(plan, map=dialog.answer("map", plan.map, str))
    if {"landmarks", "uwb", "ceiling"} & set(sensors):
        usual_arena = "x".join(f"{length:g}" for length in plan.arena)
        plan = replace(plan, arena=dialog.answer("arena", usual_arena, _arena))
    if "landmarks" in sensors:
        plan = replace(
            plan,
            pitch=dialog.answer("pitch", f"{plan.pitch:g}", number_in(0.01, 100.0, "m")),
            landmark_size=dialog.answer("landmark-size", f"{plan.landmark_size:g}", _LENGTH),
        )
    if dialog.unused:
        located = f"{name} located by {', '.join(sensors)}"
        raise UserError(f"--{dialog.unused[0]} has no meaning for robots of the type {located}.")
    return plan


def start_lines(plan: SwarmPlan, file: str) -> list[str]:
    """How to start the graph of a swarm: commands, and comments about what others must publish."""
    robot, sensors, known = f"{plan.prefix}1", set(plan.sensors), plan.known
    sheets = f"{plan.prefix.rstrip('_')}_markers"
    sees = bool(sensors & {"robots", "landmarks"})
    prints = sees or sensors & {"aerial", "ceiling"}
    lines = []
    # markers to print
    if prints:
        board = " --board 3x4" if "aerial" in sensors else ""
        lines.append(
            f"./run swarm_loc_vision print_markers {file} --family {plan.family}{board} --out {sheets}.pdf"
        )
    # drivers, or what others must publish
    if known.driver:
        lines.append(f"./run swarm_loc_drivers {known.driver.format(robot=robot, file=file)}")
    needs = [] if known.driver or known.odometry is None else [("odom", "nav_msgs/Odometry")]
    needs += [("scan", "sensor_msgs/LaserScan")] if sensors & {"lidar", "map"} else []
    needs += [("imu", "sensor_msgs/Imu")] if "imu" in sensors else []
    needs += [(f"{known.image}image_raw, camera_info", "calibrated images")] if sees else []
    lines += [f"# another node must publish {robot}/{topic}: {kind}" for topic, kind in needs]
    # what detects, localizes and maps on or for each robot
    if sees:
        names = ("image_raw", "camera_info") if known.image else ()
        remapped = "".join(f" -r {name}:={known.image}{name}" for name in names)
        described = f"-p family:={plan.family} -p swarm_file:={file} -p robot:={robot}"
        lines.append(
            f"./run swarm_loc_vision marker_detector_node --ros-args -r __ns:=/{robot}{remapped} {described}"
        )
    if sensors & {"fix", "mocap"} and known.localizer:
        source = "" if "mocap" in sensors else " -p source:=pose  # of vrpn_mocap; its page has others"
        lines.append(f"./run swarm_loc_estimator localizer_bridge --ros-args -p swarm_file:={file}{source}")
    if "uwb" in sensors:
        lines.append("# another node must publish uwb/n_FROM/n_TO/distance of each pair: sensor_msgs/Range")
    if "mapper" in sensors:
        tracker = f"-r __ns:=/{robot} -p calibration:={robot}.yaml"
        lines += [
            f"./run swarm_loc_vision event_tracker_node --ros-args {tracker}",
            f"./run swarm_loc_estimator mapper_node --ros-args -p swarm_file:={file}",
            f"./run swarm_loc_drivers exploration_node --ros-args -p swarm_file:={file}",
        ]
    if plan.robots > 1 and any(robot in line for line in lines):
        lines.append(
            f"# the lines with {robot} are needed for {plan.prefix}2 to {plan.prefix}{plan.robots}, too"
        )
    # what runs once for the swarm
    for camera in ("ceiling1", "ceiling2") if "ceiling" in sensors else ():
        described = f"-p family:={plan.family} -p swarm_file:={file} -p robot:={camera}"
        lines.append(f"./run swarm_loc_vision marker_detector_node --ros-args -r __ns:=/{camera} {described}")
    if "aerial" in sensors:
        lines.append(
            "./run swarm_loc_vision aerial_camera_node --ros-args -r __ns:=/aerial"
            f" -p control_points_file:={sheets}_board.yaml  # its page says more, such as robot_height"
        )
    parameters = f" --params-file {parameter_file(file)}" if known.tf_per_robot else ""
    return [*lines, f"./run swarm_loc_estimator graph {file} --watch{parameters}"]


def parameter_file(file: str) -> str:
    """The file of ROS parameters beside that of a description."""
    return f"{file.removesuffix('.yaml')}_params.yaml"


def launch_tree(plan: SwarmPlan, lines: Sequence[str], file: str) -> Tree:
    """A launch file, as YAML, of the nodes that `lines` start, those on robots for each one."""
    arguments = {"swarm_file": file, "watch": "true"}
    if plan.known.tf_per_robot:
        arguments["params_file"] = parameter_file(file)
    given = [{"name": name, "value": value} for name, value in arguments.items()]
    graph = "$(find-pkg-share swarm_loc_estimator)/launch/swarm.launch.py"
    actions: list[Tree] = [{"include": {"file": graph, "arg": given}}]
    first = f"{plan.prefix}1"
    for line in lines:
        package, executable, *rest = line.removeprefix("./run ").partition("  #")[0].split(maxsplit=2)
        if line.startswith("#") or "--ros-args" not in line:
            continue
        for k in range(plan.robots if f"/{first}" in line else 1):
            arguments_of = rest[0].replace(first, f"{plan.prefix}{k + 1}").removeprefix("--ros-args ")
            actions.append({"node": {"pkg": package, "exec": executable, "ros_args": arguments_of}})
    return {"launch": actions}


def remarks(plan: SwarmPlan, swarm: Swarm) -> str:
    """The comment at the top of a description."""
    lines = [
        f"{plan.robots} x {plan.known.title}, located by: {'; '.join(SENSORS[one] for one in plan.sensors)}.",
        plan.known.sources,
    ]
    if swarm.owner_of:
        lines.append(
            f"Markers are of the family {plan.family}. Measure where they and the cameras are, and write it"
            " below; a landmark whose place is not exact gets position_sigma and yaw_sigma."
        )
    if not {"landmarks", "aerial", "fix", "mapper", "map", "uwb", "ceiling", "mocap"} & set(plan.sensors):
        lines.append("Nothing here says where the robots are in map, unless one of them gets a start.")
    if {"uwb", "ceiling"} & set(plan.sensors):
        lines.append("? Places of anchors and ceiling cameras are guesses: measure them, or use survey.")
    if "fix" in plan.sensors:
        lines.append("fix: the sigmas are used for fixes without covariance.")
    lines.append(
        "The noise is a first guess: a bag with ground truth and the command calibrate give a better one."
    )
    return "\n".join(part for line in lines for part in textwrap.wrap(line, 100))


def proposed_from(bag: Path | None, seconds: float, dialog: Dialog, *, use_sim_time: bool) -> Any:
    """The `Proposal` of what a bag tells, or of what the running graph tells in some seconds."""
    doctor = "swarm_loc_estimator.doctor"
    of_heard = import_module(f"{doctor}.proposal")  # needs packages that a plan does without
    with ProgressLine() as progress:
        if bag is None:
            listen = import_module(f"{doctor}.listener").listen
            is_wanted = of_heard.is_proposed_from
            evidence = listen(Swarm(), seconds, progress, "", is_wanted, use_sim_time=use_sim_time)
        else:
            evidence = of_heard.heard_in(bag, progress)
    print(*evidence.remarks, sep="\n", end="\n" * bool(evidence.remarks), file=sys.stderr)
    known = _one_of(KNOWN_ROBOTS)
    folder = None if bag is None else bag if bag.is_dir() else bag.parent
    found = of_heard.proposed(evidence.topics, lambda likely: dialog.answer("type", likely, known), folder)
    if dialog.unused:
        raise UserError(f"--{dialog.unused[0]} has no meaning for a description of what was heard.")
    return found


@command(
    __doc__,
    argument(
        "files", type=Path, nargs="*", metavar="FILE", help="a bag, if any, and a .yaml to write (swarm.yaml)"
    ),
    argument("--live", action="store_true", help="describe what the running graph publishes"),
    argument("--seconds", type=number_in(1.0, 3600.0, "s"), help=f"how long to listen to it ({_LIVE_S:g})"),
    argument("--use-sim-time", action="store_true", help="take time from /clock"),
    argument("--yes", action="store_true", help="ask nothing; take defaults where no option is given"),
    *(argument(f"--{name}", help=question) for name, question in QUESTIONS.items()),
)
def main(options: argparse.Namespace) -> int:
    """Run the command; returns its exit status."""
    # files, and answers in advance
    bags = [one for one in options.files if not is_description(one)]
    paths = [one for one in options.files if is_description(one)] or [Path("swarm.yaml")]
    if len(bags) > (not options.live) or len(paths) > 1:
        raise UserError("new takes one bag at most, none with --live, and one .yaml file to write.")
    if not options.live and (options.seconds or options.use_sim_time):
        raise UserError("--seconds and --use-sim-time are for --live.")
    bag, path = bags[0] if bags else None, paths[0]
    if path.exists():
        raise UserError(f"{path} exists and is not overwritten.")
    answers = {name: getattr(options, name.replace("-", "_")) for name in QUESTIONS}
    given = {name: answer for name, answer in answers.items() if answer is not None}
    dialog = Dialog(given, asks=not options.yes)
    # from what was heard, or from answers
    if bag or options.live:
        found = proposed_from(bag, options.seconds or _LIVE_S, dialog, use_sim_time=options.use_sim_time)
        swarm, asked = found.swarm, [f"? {one}" for one in found.asked]
        said = [f"From {bag or 'the running graph'}.", *found.facts, *asked]
        comment = "\n".join(part for line in said for part in textwrap.wrap(line, 100))
        quoted = shlex.quote(str(path))
        lines = [*asked, f"./run swarm_loc_estimator doctor {quoted}"]
        if bag:
            lines[-1:] = [f"./run swarm_loc_estimator replay {shlex.quote(str(bag))} --swarm {quoted}"]
    else:
        plan = asked_plan(dialog)
        swarm = planned_swarm(plan)
        comment, lines = remarks(plan, swarm), start_lines(plan, shlex.quote(str(path)))
        write_tree(launch_tree(plan, lines, str(path)), path.with_suffix(".launch.yaml"))
        if plan.known.tf_per_robot:
            tree = {"/**/estimator": {"ros__parameters": {"tf_per_robot": True}}}
            write_tree(tree, Path(parameter_file(str(path))))
        lines.append(f"# all of this on one machine: ros2 launch {path.with_suffix('.launch.yaml')}")
    write_whole(path.parent / SCHEMA_FILE, schema_text())
    save_swarm(swarm, path, comment)
    print(f"{path} describes {len(swarm.robots)} robots and {len(swarm.landmarks)} landmarks.\n")
    print("\n".join(lines))
    return 0


def _one_of(words: Sequence[str] | Mapping[str, object]) -> Callable[[str], str]:
    """Reads one word out of a list."""

    def read(text: str) -> str:
        if text not in words:
            raise argparse.ArgumentTypeError(f"'{text}' must be one of {', '.join(words)}")
        return text

    return read


def _some_of(words: Sequence[str]) -> Callable[[str], tuple[str, ...]]:
    """Reads words with commas between."""

    def read(text: str) -> tuple[str, ...]:
        chosen = tuple(dict.fromkeys(word.strip() for word in text.split(",")))
        if not set(chosen) <= set(words):
            raise argparse.ArgumentTypeError(f"'{text}' must be of {', '.join(words)}")
        if len(same := {"mapper", "fix", "mocap"} & set(chosen)) > 1:
            names = " and ".join(sorted(same, reverse=True))
            raise argparse.ArgumentTypeError(f"{names} publish on the same topic: choose one of them")
        return chosen

    return read


def _prefix(text: str) -> str:
    """Reads the beginning of names."""
    longest = MAX_NAME - len(str(MAX_ROBOTS))
    if not NAME.fullmatch(text) or len(text) > longest:
        raise argparse.ArgumentTypeError(
            f"'{text}' must be at most {longest} letters, digits and underscores and start with a letter"
        )
    return text


def _arena(text: str) -> tuple[float, float]:
    """Reads two lengths."""
    length, _, width = text.partition("x")
    try:
        return number_in(0.1, 1000.0, "m")(length), number_in(0.1, 1000.0, "m")(width)
    except argparse.ArgumentTypeError:
        raise argparse.ArgumentTypeError(
            f"'{text}' must be two lengths in [0.1, 1000] m, such as 2.4x1.6"
        ) from None
