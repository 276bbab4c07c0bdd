"""Renderer: images of a world with exact depth, at any resolution."""

from __future__ import annotations

import zlib
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from mapfusion.arrays import Float
from mapfusion.geometry import inverse_pose
from predmapnet.demo_world.render.ground_light import Surroundings
from predmapnet.demo_world.render.ground_texture import FINE_TEXEL, Pyramid, paint_ground, road_of
from predmapnet.demo_world.render.image_kernels import develop, mirror_in_wet, shade_image
from predmapnet.demo_world.render.kerbs import Kerbs, heights_at, kerbs_of
from predmapnet.demo_world.render.mesh import MOST_CORNERS, Material, Mesh, build_mesh, join
from predmapnet.demo_world.render.noise import fractal_tile
from predmapnet.demo_world.render.raster import View, ZBuffer, draw_balls, draw_faces, draw_mask
from predmapnet.demo_world.render.relief import BLOCK, Relief, hide_behind_ground, meet_along, relief_of, sound_ground
from predmapnet.demo_world.render.response import Response
from predmapnet.demo_world.render.shading import facade_styles
from predmapnet.demo_world.render.shadows import contact_polygons, shadow_polygons
from predmapnet.demo_world.street.looks import Light, as_numbers, light_of
from predmapnet.demo_world.world import Solids, World
from predmapnet.scenes import Camera, Rig


@dataclass(frozen=True)
class RenderedImage:
    """One image ``(height, width, 3) uint8``, RGB, and its depth, metres along the optical axis, infinite for sky."""

    image: NDArray[np.uint8]
    depth: NDArray[np.float32]


@dataclass(frozen=True)
class _Moment:
    """All that stands and moves at one key frame.

    Attributes:
        mesh: all solids.
        relief: slopes of the ground, None where there are none.
        darkness: corners ``(k, 8, 3)`` and counts ``(k,)`` of outlines on the ground that what moves darkens, and the
            light that is left there, [0, 255].
    """

    mesh: Mesh
    relief: Relief | None
    darkness: tuple[tuple[Float, NDArray[np.int64], int], ...]


def _lamp_field(world: World) -> tuple[NDArray[np.float32], tuple[float, float]]:
    """Light of the street lamps on the ground, a cell per metre, and the position of cell (0, 0)."""
    positions = world.trajectory.ego_to_global[:, :2, 3]
    low, high = np.floor(positions.min(axis=0) - 130), np.ceil(positions.max(axis=0) + 130)
    field = np.zeros((int(high[1] - low[1]), int(high[0] - low[0])), dtype=np.float32)
    reach = 24
    for lamp in world.solids.centre[world.solids.texture == "lamp"]:
        column, row = (lamp[:2] - low).astype(int)
        rows = slice(max(row - reach, 0), max(row + reach, 0))
        columns = slice(max(column - reach, 0), max(column + reach, 0))
        window = field[rows, columns]
        if window.size:
            y, x = np.mgrid[rows, columns][:, : window.shape[0], : window.shape[1]]
            square = (x - (lamp[0] - low[0])) ** 2 + (y - (lamp[1] - low[1])) ** 2
            # Lambert's cosine and the inverse square of the distance, normalised below the lamp.
            window += (0.55 * (lamp[2] ** 2 / (square + lamp[2] ** 2)) ** 2).astype(np.float32)
    return field, (float(low[0]), float(low[1]))


def _in_sight(relief: Relief, view: View, corners: Float, counts: NDArray[np.int64]) -> tuple[Float, NDArray[np.int64]]:
    """Leave out outlines on the ground, ``(k, 8, 3)`` of ``counts (k,)`` corners, whose middle lies behind a crest."""
    rays = corners.sum(axis=1) / counts[:, None] + [0.0, 0.0, 0.3] - view.position
    met = np.ones(len(counts))
    meet_along(relief, view.position, rays, met)
    return corners[met > 0.98], counts[met > 0.98]


def _on_kerbs(world: World, kerbs: Kerbs) -> World:
    """Put what stands still on the raised ground below its middle."""
    rise = np.zeros(len(world.solids.centre))
    heights_at(kerbs, world.solids.centre, rise)
    rise[world.solids.velocity.any(axis=1)] = 0.0
    return replace(world, solids=replace(world.solids, centre=world.solids.centre + [[0.0, 0.0, 1.0]] * rise[:, None]))


class Renderer:
    """Draws one world; prepares the ground once (about two seconds), then renders any camera at any frame.

    Args:
        world: what to draw.
        supersampling: samples per pixel and direction along the edges of solids, 1 to 4.
        response: how the cameras turn light into bytes; None takes well-exposed ones.
        light: of the scene; None takes that of the world's look.
        texel: side of the finest ground texture's cells, metres.
        threads: cameras that :meth:`render_frame` draws at once. One for callers that run several processes.
    """

    def __init__(
        self,
        world: World,
        supersampling: int = 2,
        threads: int = 1,
        response: Response | None = None,
        light: Light | None = None,
        texel: float = FINE_TEXEL,
    ) -> None:
        if not 1 <= supersampling <= 4:
            raise ValueError(f"supersampling must be 1 to 4, not {supersampling}")
        self.kerbs = kerbs_of(world, road_of(world))
        self.world = world = world if self.kerbs is None else _on_kerbs(world, self.kerbs)
        self.supersampling = supersampling
        self.threads = threads
        self.light = light_of(world.look, world.seed) if light is None else light
        self._ground = paint_ground(world, self.light, texel)
        solids = world.solids
        self._moving = solids.velocity.any(axis=1) | ~solids.always
        self._standing_mesh = build_mesh(solids, np.flatnonzero(~self._moving), world.terrain)
        self.relief = None if world.terrain is None else relief_of(world.terrain, solids.centre)
        self._sunlit = np.ones(len(solids.shape), dtype=np.float32)
        if self.light.sun.any():
            self._sunlit[:] = self._shadow_at(self._ground[0], solids.centre[:, :2], solids)
        self._styles = facade_styles(len(solids.shape))
        self._lamps, self._lamps_origin = _lamp_field(world)
        self._response = Response() if response is None else response
        self._curve = self._response.tone_curve()
        # Before threads ask for them, each of which would make its own.
        self._white, self._fractal = fractal_tile(0.0, seed=8), fractal_tile(1.0)
        self._clouds, self._leaves = fractal_tile(1.7, seed=12), fractal_tile(0.6, seed=10)

    @staticmethod
    def _shadow_at(ground: Pyramid, points: Float, solids: Solids) -> NDArray[np.float32]:
        """Share of sunlight just outside the sunward side of each solid, from the painted shadows."""
        level = min(3, ground.levels.shape[1] - 1)
        x0, y0, cosine, sine, per_metre = ground.placement
        delta = points - [x0, y0]
        column = ((cosine * delta[:, 0] + sine * delta[:, 1]) * per_metre).astype(int) >> level
        row = ((cosine * delta[:, 1] - sine * delta[:, 0]) * per_metre).astype(int) >> level
        start, rows, columns = map(int, ground.levels[:, level])
        inside = (column >= 0) & (row >= 0) & (column < columns) & (row < rows)
        shade = np.ones(len(points), dtype=np.float32)
        index = start + np.clip(row, 0, rows - 1) * columns + np.clip(column, 0, columns - 1)
        shade[inside] = ground.texels[index[inside], 3] / np.float32(255)
        # A solid always lies in its own shadow: only cars, which are low, take over that of others.
        shade[solids.texture != "vehicle"] = 1.0
        return shade

    def solids_at(self, frame_index: int) -> tuple[Solids, NDArray[np.int64]]:
        """Return the solids with moving ones put where they are at a key frame, and the rows that are there."""
        solids, trajectory = self.world.solids, self.world.trajectory
        seconds = float(trajectory.timestamps[frame_index] - trajectory.timestamps[0]) * 1e-9
        centre = solids.centre.copy()
        centre[:, :2] += solids.velocity * seconds
        present = np.ones(len(centre), dtype=bool)
        if solids.lifetime is not None:
            present = (solids.lifetime[:, 0] <= seconds) & (seconds < solids.lifetime[:, 1])
        return replace(solids, centre=centre), np.flatnonzero(present)

    def mesh_at(self, frame_index: int) -> tuple[Mesh, Solids, NDArray[np.int64]]:
        """Return the mesh of a key frame, the solids in place, and the rows of those that move."""
        placed, present = self.solids_at(frame_index)
        moving = present[self._moving[present]]
        return join(self._standing_mesh, build_mesh(placed, moving, self.world.terrain)), placed, moving

    def _moment(self, frame_index: int) -> _Moment:
        """Return what all cameras share at a key frame."""
        mesh, placed, moving = self.mesh_at(frame_index)
        terrain = self.world.terrain
        relief = None if terrain is None else relief_of(terrain, placed.centre)
        chosen = np.zeros(len(placed.shape), dtype=bool)
        chosen[moving] = True
        layers: list[tuple[list[Float], int]] = []
        if self.light.sun.any():
            layers.append(
                ([polygon for polygon, _ in shadow_polygons(placed, chosen, self.light.sun_direction, terrain)], 90)
            )
        layers.append(([polygon for polygon, _ in contact_polygons(placed, chosen)], 30))
        darkness = []
        for polygons, value in layers:
            corners = np.zeros((len(polygons), MOST_CORNERS, 3))
            counts = np.zeros(len(polygons), dtype=np.int64)
            for row, polygon in enumerate(polygons):
                # A face holds few corners: keep evenly spread ones of a round outline.
                kept = polygon[
                    np.linspace(0, len(polygon), min(len(polygon), MOST_CORNERS), endpoint=False).astype(int)
                ]
                corners[row, : len(kept), :2] = kept
                if terrain is not None:
                    corners[row, : len(kept), 2] = terrain.heights(kept)
                counts[row] = len(kept)
            darkness.append((corners, counts, value))
        return _Moment(mesh, relief, tuple(darkness))

    @staticmethod
    def _dynamic_mask(view: View, moment: _Moment) -> NDArray[np.uint8]:
        """Ground darkened by what moves, ``(height, width)``, 255 where nothing does."""
        mask = np.full((view.height, view.width), 255, dtype=np.uint8)
        for corners, counts, value in moment.darkness:
            if moment.relief is not None and len(counts):
                corners, counts = _in_sight(moment.relief, view, corners, counts)
            draw_mask(corners, counts, view, value, np.empty((18, 3)), mask)
        moves = any(len(counts) for _, counts, _ in moment.darkness)
        return np.asarray(cv2.blur(mask, (3, 3)), dtype=np.uint8) if moves else mask

    def view(self, camera: Camera, frame_index: int) -> View:
        """Return a camera at a key frame as plain numbers."""
        pose = self.world.trajectory.ego_to_global[frame_index] @ camera.camera_to_ego
        rotation, position = np.ascontiguousarray(pose[:3, :3]), np.ascontiguousarray(pose[:3, 3])
        fx, fy, cx, cy = (float(camera.intrinsics[place]) for place in ((0, 0), (1, 1), (0, 2), (1, 2)))
        return View(rotation, position, fx, fy, cx, cy, camera.width, camera.height)

    def rasterise(self, mesh: Mesh, view: View, samples: int) -> ZBuffer:
        """Return the z-buffer of the solids, ``samples`` per pixel and direction."""
        nearness = np.zeros((view.height * samples, view.width * samples), dtype=np.float32)
        ids = np.full(nearness.shape, -1, dtype=np.int32)
        planes = np.empty_like(mesh.normals)
        draw_faces(mesh.corners, mesh.counts, mesh.normals, view, samples, np.empty((18, 3)), nearness, ids, planes)
        leafy = (mesh.ball_materials == Material.FOLIAGE).astype(np.int64)
        order = np.argsort(((mesh.balls[:, :3] - view.position) ** 2).sum(axis=1))
        draw_balls(mesh.balls, leafy, order, len(mesh.counts), view, samples, self._leaves, nearness, ids)
        ground = np.empty((0, 0), dtype=np.float32)
        if self.relief is not None:
            ground = np.empty((-(-view.height // BLOCK) + 1, -(-view.width // BLOCK) + 1), dtype=np.float32)
            sound_ground(self.relief, view, ground)
            hide_behind_ground(self.relief, view, samples, ground, nearness, ids)
        return ZBuffer(nearness, ids, planes, ground)

    def render(self, camera: Camera, frame_index: int) -> RenderedImage:
        """Draw what a camera sees at a key frame; the same bytes for the same world, camera and frame.

        Any pinhole camera without skew will do; its intrinsics hold for its width and height.
        """
        return self._draw(camera, frame_index, self._moment(frame_index))

    def _draw(self, camera: Camera, frame_index: int, moment: _Moment) -> RenderedImage:
        mesh = moment.mesh
        view, samples = self.view(camera, frame_index), self.supersampling
        solids = self.rasterise(mesh, view, samples)
        around = Surroundings(
            *self._ground, as_numbers(self.light), self._white, self._fractal, self._clouds,
            self._lamps, self._lamps_origin, inverse_pose(self.world.trajectory.ego_to_global[frame_index]),
            self._sunlit, self._styles,
        )  # fmt: skip
        size = (camera.height, camera.width)
        image = np.empty((*size, 3), dtype=np.float32)
        depth, ground_share = np.empty(size, dtype=np.float32), np.empty(size, dtype=np.float32)
        dynamic = self._dynamic_mask(view, moment)
        found, scratch = np.empty(16, dtype=np.int64), np.empty((8, 16))
        shade_image(
            around, moment.relief, self.kerbs, mesh, view, samples, 8, solids, dynamic, found, scratch, image, depth,
            ground_share,
        )  # fmt: skip
        if self.light.wetness > 0:
            mirror_in_wet(around, moment.relief, view, solids.ground, ground_share, image)
        return RenderedImage(self._develop(image, camera, frame_index), depth)

    def _develop(self, image: NDArray[np.float32], camera: Camera, frame_index: int) -> NDArray[np.uint8]:
        """Turn linear light into the bytes that the camera stores."""
        response, name = self._response, zlib.crc32(camera.name.encode())
        deviation = response.blur * camera.width / 800
        if deviation > 0.15:
            image = np.asarray(cv2.GaussianBlur(image, (3, 3) if deviation < 0.8 else (5, 5), deviation), np.float32)
        generator = np.random.default_rng([self.world.seed, name])
        exposures = response.exposures(len(self.world.trajectory.timestamps), generator)
        gains = (self.light.exposure * exposures[frame_index] * np.array(response.balance)).astype(np.float32)
        vignette = float(generator.uniform(0.12, 0.32))
        # Scaling a photograph down averages its noise, though neighbouring pixels share some of it.
        noise = response.noise * self.light.noise / 0.18**0.5 / 0.42 * min(1.0, camera.width / 800) ** 0.5
        seed = int(np.random.default_rng([self.world.seed, name, frame_index]).integers(2**31))
        out = np.empty(image.shape, dtype=np.uint8)
        develop(image, gains, vignette, noise, seed, self._curve, out)
        return out

    def render_frame(self, rig: Rig, frame_index: int) -> dict[str, RenderedImage]:
        """Draw all cameras of a rig at a key frame, ``threads`` at a time; by camera name."""
        moment = self._moment(frame_index)
        if self.threads == 1:
            return {camera.name: self._draw(camera, frame_index, moment) for camera in rig}
        with ThreadPoolExecutor(self.threads) as pool:
            images = pool.map(lambda camera: self._draw(camera, frame_index, moment), rig)
            return {camera.name: image for camera, image in zip(rig, images, strict=True)}
