"""Which nodes a graph has, and how a node is told who it is."""

from swarm_loc_estimator.common.launch import GraphOptions, NodeSpec, graph_nodes, parsed_options


def test_a_live_graph_is_the_estimator_on_the_wall_clock() -> None:
    (estimator,) = graph_nodes(GraphOptions("swarm.yaml"))

    assert (estimator.package, estimator.executable) == ("swarm_loc_estimator", "estimator_node")
    assert estimator.parameters == {"swarm_file": "swarm.yaml", "use_sim_time": False}


def test_a_bag_brings_its_player_and_its_clock() -> None:
    estimator, player = graph_nodes(GraphOptions("swarm.yaml", bag="bags/eight", rate=4.0))

    assert estimator.parameters["use_sim_time"] is True
    assert player.executable == "play"
    assert player.parameters == {"bag": "bags/eight", "rate": 4.0, "wait_for_subscribers": 1}


def test_arguments_keep_types_spaces_and_order() -> None:
    node = NodeSpec(
        "package",
        "executable",
        "node",
        namespace="epuck1",
        parameters={"file": "a b: c.yaml", "on": True, "count": 5, "gain": 5.0, "code": "012"},
        parameter_file="all.yaml",
    )

    assert node.ros_arguments() == [
        *("--ros-args", "-r", "__node:=node", "-r", "__ns:=/epuck1", "--params-file", "all.yaml"),
        *(
            "-p",
            'file:="a b: c.yaml"',
            "-p",
            "on:=true",
            "-p",
            "count:=5",
            "-p",
            "gain:=5.0",
            "-p",
            'code:="012"',
        ),
    ]


def test_the_command_line_becomes_options() -> None:
    line = ["swarm.yaml", "--bag", "bags/eight", "--rate", "2", "--params-file", "all.yaml"]

    expected = GraphOptions("swarm.yaml", "bags/eight", 2.0, parameter_file="all.yaml")
    assert parsed_options(GraphOptions, None, line) == expected
