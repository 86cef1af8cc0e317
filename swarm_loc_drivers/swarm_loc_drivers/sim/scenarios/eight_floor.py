"""Ground control of the arena of the eight: markers on its floor, off the robots' way."""

from __future__ import annotations

from swarm_loc_drivers.sim.scenarios.eight import ARENA
from swarm_loc_drivers.sim.scenarios.eight_images import FAMILY
from swarm_loc_vision.aerial.ground.floor_markers import FloorMarker
from swarm_loc_vision.aerial.ground.ground_control import Ground
from swarm_loc_vision.markers.families import family_named

_SIZE, _FROM_WALL = 0.12, 0.15


def eight_floor() -> Ground:
    """Six markers along the longer walls; their ids are the last ones of the family."""
    family = family_named(FAMILY)
    x, y = 0.5 * ARENA[0] - _FROM_WALL, 0.5 * ARENA[1] - _FROM_WALL
    places = [(a * x, b * y) for b in (-1.0, 1.0) for a in (-1.0, 0.0, 1.0)]
    first = len(family.words) - len(places)
    markers = tuple(
        FloorMarker(first + k, round(a, 6), round(b, 6), size=_SIZE) for k, (a, b) in enumerate(places)
    )
    return Ground(markers=markers, family=family)
