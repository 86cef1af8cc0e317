"""ROS parameters of `mapper_node`. No ROS here."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, field

from swarm_loc_estimator.common.parameters import ParameterError, number, text, texts
from swarm_loc_estimator.mapping.settings import MapperSettings


@dataclass(frozen=True)
class MapperParameters:
    """Parameters of `mapper_node`; those of the mapper itself are its settings."""

    swarm_file: str = text("", "path of the swarm description", required=True)
    robots: tuple[str, ...] = texts("those that map; empty: all of the description")
    led_frequencies: tuple[str, ...] = texts(
        "of the robots' LEDs, such as pushbot1=1000 [Hz]; empty: lights are not used"
    )
    map_frame: str = text("map", "frame of the map, the fixes and the goals", required=True)
    map_period_s: float = number(2.0, "s", 0.1, 60.0, "period in which a changed map is published")
    load_map: str = text("", "path of a map's YAML that is put below what the robots see; empty: none")
    save_map: str = text("map.yaml", "path of the files that ~/save_map writes", required=True)
    settings: MapperSettings = field(default_factory=MapperSettings, metadata={"numbers_of": MapperSettings})


def chosen_robots(wanted: Collection[str], known: Collection[str]) -> list[str]:
    """The names of the robots that map, in the order of the description.

    Raises:
        ParameterError: One of those wanted is not known.
    """
    for name in wanted:
        if name not in known:
            raise ParameterError(f"parameter robots: there is no robot '{name}' in the swarm description.")
    return [name for name in known if not wanted or name in wanted]
