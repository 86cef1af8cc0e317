"""The swarm description: robots, sensors, landmarks and infrared boards, as dataclasses and as YAML."""
