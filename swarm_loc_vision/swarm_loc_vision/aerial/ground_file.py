"""Control points of an overhead camera in a YAML file: points, floor markers, intrinsics."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from swarm_loc_estimator.common.codec import WHOLE_FILE, Tree, TreeChecks, entry_specs, nearest, to_tree
from swarm_loc_estimator.common.parameters import NumberSpec, UserError, number_specs
from swarm_loc_estimator.common.yaml_tree import read_tree, write_tree
from swarm_loc_vision.aerial.control_points import ControlPoints, check_points
from swarm_loc_vision.aerial.ground_control import FloorMarker, Ground
from swarm_loc_vision.common.camera import Camera
from swarm_loc_vision.markers.families import Family, families

_PLACE = NumberSpec("m", -1e4, 1e4, False, "in map")
_PIXEL = NumberSpec("px", -1e5, 1e5, False, "in the raw image")
_POINT = {"x": _PLACE, "y": _PLACE, "z": _PLACE, "u": _PIXEL, "v": _PIXEL}
_REQUIRED = ("x", "y", "u", "v")
_CAMERA = {
    "width": NumberSpec("px", 1, 1e5, False, "columns"),
    "height": NumberSpec("px", 1, 1e5, False, "rows"),
    **{name: NumberSpec("px", -1e6, 1e6, False, "intrinsics") for name in ("fx", "fy", "cx", "cy")},
}


class GroundFileError(UserError):
    """An invalid file of control points; the message is one sentence."""


def load_ground(path: Path) -> Ground:
    """Read control points.

    Raises:
        GroundFileError: It cannot be read, a value is wrong, or the points do not determine a pose.
    """
    return _Reader(path, GroundFileError).ground(read_tree(path, GroundFileError))


def save_ground(ground: Ground, path: Path, comment: str = "") -> None:
    """Write control points and floor markers for `load_ground`."""
    points = ground.points
    rows = zip(points.names, points.places.tolist(), points.pixels.tolist(), strict=True)
    tree = {
        "points": {name: dict(zip("xyzuv", [*place, *pixel], strict=True)) for name, place, pixel in rows},
        "family": ground.family.name,
        "markers": {one.id: to_tree(one, keep=number_specs(FloorMarker)) for one in ground.markers},
    }
    write_tree(tree, path, comment.splitlines())


class _Reader(TreeChecks):
    """Takes control points out of one file."""

    def ground(self, tree: Tree) -> Ground:
        sections = self.mapping(tree, WHOLE_FILE, ("points", "family", "markers", "camera"))
        points = self._points(self.mapping(sections.get("points"), "points"))
        family = self._family(sections.get("family", "aruco_mip_36h12"))
        markers = self._markers(self.mapping(sections.get("markers"), "markers"), family)
        if not markers:
            self.made("", check_points, points=points)
        return Ground(points, markers, family, self._camera(sections.get("camera")))

    def _points(self, tree: dict[Any, Tree]) -> ControlPoints:
        rows = [self.values(entry, f"points.{name}", _POINT, _REQUIRED) for name, entry in tree.items()]
        values = np.array([[row.get(key) or 0.0 for key in _POINT] for row in rows], float).reshape(-1, 5)
        return ControlPoints([str(name) for name in tree], values[:, :3], values[:, 3:])

    def _family(self, name: Tree) -> Family:
        known = families()
        if not isinstance(name, str) or name not in known:
            raise self.said(f"family is {name!r}, which is none{nearest(str(name), known)}")
        return known[name]

    def _markers(self, tree: dict[Any, Tree], family: Family) -> tuple[FloorMarker, ...]:
        markers = []
        for marker_id, entry in tree.items():
            if not isinstance(marker_id, int) or not 0 <= marker_id < len(family.words):
                raise self.said(
                    f"markers has {marker_id!r}, but ids of {family.name} are 0 to {len(family.words) - 1}"
                )
            required = ("x", "y", "size")
            values = self.values(entry, f"markers.{marker_id}", entry_specs(FloorMarker), required)
            markers.append(FloorMarker(marker_id, **values))
        return tuple(markers)

    def _camera(self, tree: Tree) -> Camera | None:
        if tree is None:
            return None
        section = self.mapping(tree, "camera", (*_CAMERA, "distortion_model", "distortion"), _CAMERA)
        values: dict[str, Any] = {
            k: self.number(section[k], f"camera.{k}", spec) for k, spec in _CAMERA.items()
        }
        values |= {key: int(values[key]) for key in ("width", "height")}
        values["distortion"] = self.list_of_numbers(section.get("distortion", []), "camera.distortion")
        return self.made("", Camera, model=str(section.get("distortion_model", "plumb_bob")), **values)
