"""Give an Argoverse 2 log images, in its own layout: its map, drive and cameras, drawn by our renderer.

Cameras are pinholes of a fraction of their size, so the intrinsics of the copy are its own.
"""

from __future__ import annotations

import shutil
import zlib
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import orjson
import pyarrow
from pyarrow import feather

from predmapnet.datasets.argoverse2 import KEY_FRAME_STRIDE
from predmapnet.datasets.argoverse2_files import POSES, SWEEP_LIST, every_sweep
from predmapnet.demo_world.render.renderer import Renderer
from predmapnet.demo_world.street.dressing import dress
from predmapnet.demo_world.world import Look
from predmapnet.errors import UserError
from tests.real_roads.argoverse_logs import read_log

JPEG_QUALITY = 90


def write_with_images(log: Path, root: Path, frames: int, scale: float, look: Look = Look.DAY) -> Path:
    """Write the first frames of a log with the images of its seven cameras; what is drawn already stays.

    Args:
        log: folder of a log with map and calibration.
        root: of the new data set; the log keeps its name in it.
        frames: how many key frames.
        scale: of the images.
        look: light and weather.

    Raises:
        UserError: the log has no calibration or no map.
    """
    logged = read_log(log)
    if logged.rig is None:
        raise UserError(f"{log} has no calibration.")
    folder = root / log.name
    shutil.copytree(log / "map", folder / "map", dirs_exist_ok=True)
    shutil.copytree(log / "calibration", folder / "calibration", dirs_exist_ok=True)
    shutil.copy(log / POSES, folder / POSES)
    (folder / SWEEP_LIST).write_bytes(orjson.dumps(every_sweep(log)[: frames * KEY_FRAME_STRIDE].tolist()))
    table = feather.read_table(log / "calibration" / "intrinsics.feather").to_pydict()
    names = table["sensor_name"]
    sizes = [np.round(np.multiply(scale, size)) for size in zip(table["width_px"], table["height_px"], strict=True)]
    rows = dict(zip(names, sizes, strict=True))
    smaller = {"fx_px": 0, "cx_px": 0, "fy_px": 1, "cy_px": 1, "width_px": 0, "height_px": 1}
    old = {"width": table["width_px"], "height": table["height_px"]}
    for column, axis in smaller.items():
        ratio = [size[axis] / (old["width"], old["height"])[axis][row] for row, size in enumerate(sizes)]
        scaled = [value * each for value, each in zip(table[column], ratio, strict=True)]
        table[column] = [round(value) for value in scaled] if column.endswith(("width_px", "height_px")) else scaled
    for column in ("k1", "k2", "k3"):
        table[column] = [0.0] * len(names)
    feather.write_feather(pyarrow.table(table), folder / "calibration" / "intrinsics.feather")
    rig = tuple(_of_size(camera, *rows[camera.name]) for camera in logged.rig)
    renderer = Renderer(dress(logged.vector_map, logged.trajectory, look, zlib.crc32(log.name.encode()), log.name[:8]))
    for row, stamp in enumerate(logged.trajectory.timestamps[:frames].tolist()):
        paths = {camera.name: folder / "sensors" / "cameras" / camera.name / f"{stamp}.jpg" for camera in rig}
        if all(path.is_file() for path in paths.values()):
            continue
        for name, rendered in renderer.render_frame(rig, row).items():
            paths[name].parent.mkdir(parents=True, exist_ok=True)
            cv2.imwrite(str(paths[name]), rendered.image[:, :, ::-1], [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    return folder


def _of_size(camera, width: float, height: float):
    scale = np.diag([width / camera.width, height / camera.height, 1.0])
    return replace(camera, width=round(width), height=round(height), intrinsics=scale @ camera.intrinsics)
