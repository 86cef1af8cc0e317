"""The whole graph of a swarm as data: which nodes run, with which names, parameters and remappings.

`ros2 launch swarm_loc_estimator swarm.launch.py` and the `graph` command start the same list.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field

from swarm_loc_estimator.common.number_spec import number

ParameterValue = bool | int | float | str | list[str]


@dataclass(frozen=True)
class GraphOptions:
    """What a user chooses about a graph.

    Attributes:
        swarm_file: Path of the swarm description.
        bag: Path of a bag to play into the graph, which then runs on the bag's clock; None: live robots.
        rate: Speed of that bag, 1 for real time.
        use_sim_time: Whether the nodes take their time from /clock though no bag is played here.
        parameter_file: Path of a ROS parameter file for all nodes, None for none.
        watch: Whether a page shows the swarm to browsers of this machine.
        watch_port: Where, 0 for any port that is free.
    """

    swarm_file: str
    bag: str | None = None
    rate: float = number(1.0, "1", 0.01, 1000.0, "speed of the bag")
    use_sim_time: bool = False
    parameter_file: str | None = None
    watch: bool = False
    watch_port: int = number(8420, "1", 0, 65535, "port of the page")


@dataclass(frozen=True)
class NodeSpec:
    """One node of a graph.

    Attributes:
        package: Package of the executable.
        executable: Name of the executable.
        name: Name of the node.
        namespace: Namespace of the node, "" for none.
        parameters: Parameter -> value; they win over the parameter file.
        parameter_file: Path of a ROS parameter file, None for none.
        remappings: Pairs of names, from and to.
        required: Whether the graph ends when this node ends.
    """

    package: str
    executable: str
    name: str
    namespace: str = ""
    parameters: Mapping[str, ParameterValue] = field(default_factory=dict)
    parameter_file: str | None = None
    remappings: tuple[tuple[str, str], ...] = ()
    required: bool = True

    @property
    def full_name(self) -> str:
        """Name with the namespace before it, unique in a graph."""
        return f"{self.namespace}/{self.name}" if self.namespace else self.name

    def ros_arguments(self) -> list[str]:
        """The command-line arguments that make the executable this node."""
        arguments = ["--ros-args", "-r", f"__node:={self.name}"]
        if self.namespace:
            arguments += ["-r", f"__ns:=/{self.namespace}"]
        if self.parameter_file is not None:
            arguments += ["--params-file", self.parameter_file]
        for name, value in self.parameters.items():
            arguments += ["-p", f"{name}:={json.dumps(value)}"]
        for source, target in self.remappings:
            arguments += ["-r", f"{source}:={target}"]
        return arguments


def graph_nodes(options: GraphOptions) -> list[NodeSpec]:
    """The nodes of a swarm's graph, in the order in which they start.

    Args:
        options: What the user chose.

    Returns:
        The estimator, the player where a bag is played, and the page where it is wanted.
    """
    package = "swarm_loc_estimator"
    time = {"use_sim_time": options.use_sim_time or options.bag is not None}
    estimator: dict[str, ParameterValue] = {"swarm_file": options.swarm_file, **time}
    nodes = [
        NodeSpec(
            package,
            "estimator_node",
            "estimator",
            parameters=estimator,
            parameter_file=options.parameter_file,
        )
    ]
    if options.bag is not None:
        # The estimator starts more slowly than the player: the bag begins when someone listens.
        player: dict[str, ParameterValue] = {
            "bag": options.bag,
            "rate": options.rate,
            "wait_for_subscribers": 1,
        }
        nodes.append(
            NodeSpec(package, "play", "player", parameters=player, parameter_file=options.parameter_file)
        )
    if options.watch:
        page: dict[str, ParameterValue] = {
            "swarm_file": options.swarm_file,
            "port": options.watch_port,
            **time,
        }
        nodes.append(
            NodeSpec(
                package,
                "watch_node",
                "watch",
                parameters=page,
                parameter_file=options.parameter_file,
                required=False,
            )
        )
    return nodes
