# The workspace on an installed ROS 2 Jazzy.
#
#     docker build --tag swarm-localization .
#     docker run --rm swarm-localization                                                         the demo
#     docker run --rm swarm-localization swarm_loc_estimator replay bags/eight_five_robots       any ./run line
#     docker run --rm swarm-localization -- make test                                            the tests
FROM ros:jazzy

# hadolint ignore=DL3008
RUN apt-get update \
    && apt-get install --yes --no-install-recommends \
        cmake \
        g++ \
        make \
        python3-dev \
        python3-venv \
        ros-jazzy-domain-coordinator \
    && rm -rf /var/lib/apt/lists/*

RUN useradd --create-home --uid 1001 swarm && install --directory --owner swarm --group swarm /workspace
USER 1001
WORKDIR /workspace
COPY --chown=swarm:swarm . .

# ROS 2 is sourced, so .venv takes it from the system and holds only requirements/workspace.txt.
RUN . /opt/ros/jazzy/setup.sh && make setup

ENTRYPOINT ["/ros_entrypoint.sh", "./run"]
CMD ["swarm_loc_estimator", "demo"]
