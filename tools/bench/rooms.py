"""Surfaces of procedural rooms out of a few frames, by each method, against the rooms themselves.

    python tools/bench/rooms.py --rooms 2 --frames 10 20

Rooms of the split `test`, which nothing is trained on, seen by a camera like a Kinect's (640x480, focal
length 585) on a hand-held path inside: without noise, with half of a Kinect's, with one and a half times as
much. At 256^3 in the box of the room, in voxels of about 2 cm. Rays that meet nothing are not measured.

Accuracy is the mean distance from the surface to what can be seen of the room at all, completeness that from
what the frames see to the surface, F-score the harmonic mean of the shares within one voxel. "thin" is the
share, within a voxel, of what the frames see of things thinner than 3 voxels: legs, boards, lamps. "flat" is
the standard deviation from flat on walls, floor and ceiling, away from all else.
"""

from __future__ import annotations

import argparse

import numpy as np
import torch
from numba import set_num_threads
from reconstructions import (
    RESOLUTION,
    SAMPLES,
    Comparison,
    Truth,
    compare,
    flat_part,
    methods,
    table_of,
)
from rich.console import Console
from rich.progress import track

from ocnf_data.fusion import fuse_tsdf
from ocnf_data.generation.records import Item
from ocnf_data.meshes import Mesh
from ocnf_data.render import render_depth
from ocnf_data.scenes import draft_scene, scene_mesh
from ocnf_data.synthesis.draw import Body
from ocnf_data.synthesis.scenes import PlacedScene, place_scene, truth_cameras
from ocnf_data.views.cameras import Views
from ocnf_data.views.rigs import intrinsics
from ocnf_data.views.scans import Scan
from ocnf_data.views.sensor import add_sensor_noise, sensor_draws
from ocnf_data.views.trajectories import path_inside
from ocnf_model.checkpoint import SHIPPED
from ocnf_model.measures.reference import visible
from ocnf_model.measures.surface import Samples, Surface, sample_triangles
from ocnf_model.measures.thickness import local_thickness
from ocnf_model.scan.region import Region

NOISE = {"none": 0.0, "weak": 0.5, "strong": 1.5}
_K, _SIZE = intrinsics(585.0, 585.0, 320.0, 240.0), (480, 640)
_SEED = 0
_MANY = 300_000  # samples of a room, most of which nothing can see
_ALL_AROUND = 120  # views that tell what can be seen at all
_THIN = 3.0  # voxels
_WALK, _FROM_WALLS, _MARGIN = (0.9, 1.8), 0.4, 0.2  # metres, as in the training of `pretrained-scan`
_EXACT = 1e-4  # metres off a wall that are the wall


class Room:
    """A room, in the cube of its box at its real size.

    Args:
        index: number of the room in the split.
    """

    def __init__(self, index: int) -> None:
        self.name = f"room-{index}"
        draft = draft_scene("rooms", _SEED, index, "test")
        self.mesh: Mesh = scene_mesh(draft)
        body = Body(Item(self.name, "test", "rooms", self.name, index=index))
        longest = float(np.ptp(self.mesh.vertices, axis=0).max())
        self._placed: PlacedScene = place_scene(draft, self.mesh, body, longest / 0.95, 0.05)  # so scale is 1
        low, high = self._placed.bounds
        self.region = Region.of_box([*low, *high])
        self.voxel = self.region.size / RESOLUTION
        self.walls = [part.vertices for part, name in draft.parts if name == "shell"]
        self._prepare()

    def _prepare(self) -> None:
        """What can be seen of it, how thick it is there, and where it is flat."""
        R, T = truth_cameras(self._placed, _SEED, _ALL_AROUND)
        T = T + np.einsum("vij,j->vi", R, self._placed.offset)  # from the cube's middle to the room's origin
        views = self.see(R, T)
        triangles = self.mesh.vertices[self.mesh.faces]
        many = sample_triangles(triangles, _MANY)
        self.seen: Samples = many.chosen(visible(many.points, views, self.voxel / 2))
        self.surface = Surface.around(self.seen, triangles)
        truth = fuse_tsdf(views, RESOLUTION, self.region.size, centre=self.region.centre)
        self.thin = local_thickness(truth, self.seen.points - self.region.centre, self.seen.normals,
                                    4 * self.voxel, self.region.size) < _THIN * self.voxel
        self.planes = [flat_part(self.seen.points, on, normal, offset, self.voxel)
                       for normal, offset in self._wall_planes()
                       if (on := np.abs(self.seen.points @ normal - offset) < _EXACT).mean() > 0.02]

    def _wall_planes(self) -> list[tuple[np.ndarray, float]]:
        found = {(axis, round(float(side(part[:, axis])), 5)) for part in self.walls for axis in range(3)
                 for side in (np.min, np.max)}
        return [(np.eye(3)[axis], offset) for axis, offset in sorted(found)]

    def see(self, R: np.ndarray, T: np.ndarray) -> Views:
        """Views without noise."""
        return Views(render_depth(self.mesh.vertices, self.mesh.faces, _K, R, T, _SIZE), _K, R, T)

    def walk(self, n: int) -> Views:
        """The views of a hand-held path, the same path for any number n of them."""
        low, high = self._placed.bounds
        return self.see(*path_inside(
            n, _SEED, self.name, (*(low[:2] + _FROM_WALLS), _WALK[0]), (*(high[:2] - _FROM_WALLS), _WALK[1]),
            self._placed.clearance, _MARGIN)).without_background()

    def measured(self, clean: Views, strength: float) -> Scan:
        """The views with a Kinect's noise."""
        depth = [add_sensor_noise(image, _K, sensor_draws(_SEED, self.name, i, _SIZE), strength)
                 for i, image in enumerate(clean.depth)]
        return Scan(clean.with_depth(np.stack(depth)), tuple(map(str, range(len(clean)))))

    def truth(self, clean: Views) -> Truth:
        """What surfaces of these views are held against."""
        asked = np.flatnonzero(visible(self.seen.points, clean, self.voxel / 2))
        asked = asked[::max(len(asked) // SAMPLES, 1)]
        return Truth(self.surface, self.seen.points[asked], self.thin[asked], self.planes, self.voxel)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rooms", type=int, default=2)
    parser.add_argument("--frames", nargs="+", type=int, default=[10, 20])
    parser.add_argument("--runs", nargs="*", help="networks, by the names or folders of their runs")
    parser.add_argument("--threads", type=int, default=1)
    arguments = parser.parse_args()
    set_num_threads(arguments.threads)
    torch.set_num_threads(arguments.threads)
    chosen = methods(SHIPPED if arguments.runs is None else arguments.runs)
    names = [(str(n), noise, method) for n in arguments.frames for noise in NOISE for method in chosen]
    rows: dict[tuple[str, ...], list[Comparison]] = {name: [] for name in names}
    voxels = []
    for index in track(range(arguments.rooms), "rooms", console=Console(stderr=True)):
        room = Room(index)
        voxels.append(f"{1000 * room.voxel:.1f}")
        for n in arguments.frames:
            clean = room.walk(n)
            truth = room.truth(clean)
            for noise, strength in NOISE.items():
                scan = room.measured(clean, strength)
                for method, make in chosen.items():
                    rows[str(n), noise, method].append(compare(make(scan, room.region), truth))
    Console().print(table_of(f"{arguments.rooms} rooms, voxels of {', '.join(voxels)} mm",
                             ("frames", "noise", "method"), rows))


if __name__ == "__main__":
    main()
