"""Fill the cache of frames: any data set, frame by frame, and demo towns, drawn straight at the network's size."""

from __future__ import annotations

import multiprocessing
import time
from collections.abc import Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor, as_completed
from functools import partial
from hashlib import sha256
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mapfusion.array_files import read_arrays
from mapfusion.elements import ElementKind
from predmapnet.config import LookupBevConfig, PredMapNetConfig
from predmapnet.datasets.images import read_camera_image
from predmapnet.demo_world.catalogue import default_cache
from predmapnet.demo_world.training_drive import training_drive
from predmapnet.errors import UserError
from predmapnet.frame_cache.depth_targets import depth_of_frame
from predmapnet.frame_cache.scene_cache import (
    INDEX,
    JPEG_OPTIONS,
    CachedScene,
    encoded_images,
    frame_arrays,
    frame_path,
    write_arrays,
)
from predmapnet.machine import begin_loading
from predmapnet.network.calibration import calibrate
from predmapnet.network.image_input import stack_windows, window_camera
from predmapnet.scenes import Frame, FrameTruth, Image, Report, Scene, SceneSource

REPORT_SECONDS = 10.0
BYTES_PER_IMAGE, BYTES_PER_PIXEL = 5000, 0.25
"""Of the JPEGs: measured on photographs of nuScenes at 480 x 800 and on demo towns at 144 x 384."""


class FilledFrame(NamedTuple):
    """Record of one frame.

    Attributes:
        made: whether it was not there, damaged, or made from something else.
        size: bytes.
        cameras: that have an image.
        masked: that have none.
        problem: what is wrong with the first image that should be there.
    """

    made: bool
    size: int
    cameras: int
    masked: int
    problem: str


def expected_bytes(images: int, config: PredMapNetConfig) -> float:
    """Return about how many bytes the cache of some images takes."""
    return images * (BYTES_PER_IMAGE + config.image.width * config.image.height * BYTES_PER_PIXEL)


def fill_from_source(
    source: SceneSource, names: Sequence[str], folder: Path, config: PredMapNetConfig, threads: int, report: Report
) -> None:
    """Bring scenes of a data set into the cache; what is there is checked, and made anew where it is damaged or old.

    Scenes without a map, and frames without any image, are left out, with a line that says so. Threads are enough:
    decoding, scaling and encoding let go of the interpreter. Ground truth is shared with ``evaluate``.

    Args:
        source: the data set.
        names: of the scenes.
        folder: of the data set in the cache.
        config: of the network that is going to be trained.
        threads: how many frames are made side by side.
        report: gets lines for the user.
    """
    total = sum(info.frames for info in source.scenes() if info.name in names)
    done: list[FilledFrame] = []
    told = time.monotonic()
    with ThreadPoolExecutor(threads) as pool:
        for name in names:
            scene = source.open(name)
            truths = scene.truths(config.roi, default_cache() / "ground-truth")
            if truths is None:
                report(f"{name} has no map to learn from: it is left out.")
                continue
            if not done:
                size = expected_bytes(total * len(scene.rig), config) / 1e9
                report(
                    f"The cache of {total} frames of {len(scene.rig)} cameras in {folder} takes about {size:.1f} GB."
                )
            (folder / name).mkdir(parents=True, exist_ok=True)
            before = len(done)
            for filled in pool.map(partial(cache_frame, folder / name, scene, truths, config), range(len(scene))):
                done.append(filled)
                if time.monotonic() - told > REPORT_SECONDS:
                    told = time.monotonic()
                    report(f"{source.name}: {len(done)} of {total} frames, {sum(each.made for each in done)} new")
            kept = [index for index, filled in enumerate(done[before:]) if filled.cameras]
            write_index(folder / name, kept, truths)
            if len(kept) < len(scene):
                report(f"{name}: {len(scene) - len(kept)} frames without any image are left out.")
    size, made = sum(each.size for each in done) / 1e9, sum(each.made for each in done)
    report(f"{source.name}: {len(done)} frames in the cache ({size:.2f} GB), {made} of them new.")
    if masked := sum(each.masked for each in done):
        problem = next((each.problem for each in done if each.problem), "")
        report(f"{source.name}: {masked} images cannot be used, their cameras are masked. {problem}")


def cache_frame(
    folder: Path, scene: Scene, truths: Sequence[FrameTruth], config: PredMapNetConfig, index: int
) -> FilledFrame:
    """Bring a frame into the cache of its scene, unless it is there, whole, and made from the same."""
    frame, path = scene.frame(index), frame_path(folder, index)
    arrays = frame_arrays(frame.ego_to_global, calibrate(frame.rig, config), truths[index])
    origin, problems = _origin(frame, arrays), list[str]()
    try:
        stored = read_arrays(path)
    except (OSError, ValueError):
        stored = {}
    made = not np.array_equal(stored.get("origin", ()), origin)
    if made:
        images, problems = _readable_images(frame)
        windows, valid = stack_windows(images, frame.rig, config.image)
        stored = {**arrays, **encoded_images(np.rint(windows).astype(np.uint8), valid), "origin": origin}
        if config.depth.enabled:
            stored["depth"] = depth_of_frame(scene.lidar(index), frame.rig, config)
        write_arrays(path, stored)
    valid = stored["camera_valid"]
    return FilledFrame(made, path.stat().st_size, valid.sum(), (~valid).sum(), "".join(problems[:1]))


def _origin(frame: Frame, arrays: Mapping[str, NDArray[Any]]) -> NDArray[np.uint8]:
    """Digest of what a frame is made from; an image file is known by its name and size."""
    digest = sha256(repr(JPEG_OPTIONS).encode())
    for camera in frame.rig:
        path = frame.images.get(camera.name)
        file = (path.name, path.stat().st_size) if isinstance(path, Path) and path.is_file() else None
        digest.update(repr((camera.name, camera.width, camera.height, file)).encode())
        digest.update(b"" if camera.lens is None else repr(camera.lens).encode())
    for name, array in arrays.items():
        digest.update(name.encode() + np.ascontiguousarray(array).tobytes())
    return np.frombuffer(digest.digest(), np.uint8)


def _readable_images(frame: Frame) -> tuple[dict[str, Image], list[str]]:
    """Images by camera, and what is wrong with those that should be there."""
    images, problems = {}, [str(problem) for problem in frame.missing.values()]
    for camera in frame.rig:
        if camera.name in frame.images:
            try:
                images[camera.name] = read_camera_image(frame.images[camera.name], camera)
            except UserError as error:
                problems.append(str(error))
    return images, problems


def write_index(folder: Path, frames: Sequence[int], truths: Sequence[FrameTruth]) -> None:
    """Write which frames of a scene can be used; with this, the scene is complete."""
    crossings = [ElementKind.PED_CROSSING in truths[frame].kinds for frame in frames]
    index = {"numbers": np.array(frames, np.int64), "with_crossing": np.array(crossings, np.bool_)}
    write_arrays(folder / INDEX, index)


def fill_with_demo(
    folder: Path, names: Sequence[str], config: PredMapNetConfig, processes: int, report: Report
) -> None:
    """Draw the demo scenes that the cache lacks, or has damaged.

    Args:
        folder: of the demo world in the cache.
        names: of the scenes.
        config: of the network that is going to be trained.
        processes: how many draw side by side.
        report: gets a line per scene.
    """
    missing = [name for name in names if not _is_whole(folder / name)]
    if not missing:
        return
    report(f"Drawing {len(missing)} of {len(names)} demo scenes for training into {folder}.")
    pool = ProcessPoolExecutor(processes, multiprocessing.get_context("spawn"), initializer=begin_loading)
    try:
        jobs = {pool.submit(cache_demo_scene, folder / name, config): name for name in missing}
        for done, job in enumerate(as_completed(jobs), start=1):
            job.result()
            report(f"{done}/{len(missing)} {jobs[job]}")
    except BaseException:
        for process in list((getattr(pool, "_processes", None) or {}).values()):
            process.kill()  # It would finish its scene first.
        raise
    finally:
        pool.shutdown(cancel_futures=True)


def _is_whole(folder: Path) -> bool:
    try:
        scene = CachedScene(folder)
        return all(scene.frame(index) for index in range(len(scene)))
    except UserError:
        return False


def cache_demo_scene(folder: Path, config: PredMapNetConfig) -> None:
    """Draw one demo scene at the network's size.

    Training scenes have a car of their own where the network takes any rig: MapTracker's view transform has learned
    where its six cameras sit.

    Args:
        folder: where to; its name is the scene's.
        config: of the network.
    """
    window = partial(window_camera, config=config.image)
    any_car = isinstance(config.bev, LookupBevConfig)
    drive = training_drive(folder.name, window, config.roi, any_car, config.depth.enabled)
    folder.mkdir(parents=True, exist_ok=True)
    calibration, everywhere = calibrate(drive.rig, config), np.ones(len(drive.rig), np.bool_)
    for number, (pose, truth) in enumerate(zip(drive.ego_to_global, drive.truths, strict=True)):
        arrays = {**frame_arrays(pose, calibration, truth), **encoded_images(drive.images[number], everywhere)}
        if drive.sweeps is not None:
            arrays["depth"] = depth_of_frame(drive.sweeps[number], drive.rig, config)
        write_arrays(frame_path(folder, number), arrays)
    write_index(folder, range(len(drive.truths)), drive.truths)
