"""A ROS 2 bag becomes a log of one's own."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from predmapnet.datasets.bags.cameras import BagCamera, cameras_of
from predmapnet.datasets.bags.contents import Contents, Reader, contents_of
from predmapnet.datasets.bags.image_messages import image_file
from predmapnet.datasets.bags.storage import Bag, BytesRead
from predmapnet.datasets.own_logs.calibration import CALIBRATION, write_calibration
from predmapnet.datasets.own_logs.made_log import MadeLog, check_made_log, count_and_rate
from predmapnet.datasets.own_logs.pose_files import POSE_FILES
from predmapnet.datasets.own_logs.timed_poses import write_timed_poses
from predmapnet.errors import UserError
from predmapnet.files import whole_folder
from predmapnet.scenes import Progress


@dataclass(frozen=True)
class BagOptions:
    """Choices of a user where a guess would be wrong.

    Attributes:
        camera_topics: image topics to take; all that can be used if empty.
        base_frame: frame of the car.
        poses: odometry topic, or frame that the poses are in.
        height: of the car's frame above the road, metres.
    """

    camera_topics: Sequence[str] = ()
    base_frame: str | None = None
    poses: str | None = None
    height: float | None = None


def log_from_bag(
    path: Path, out: Path, options: BagOptions | None = None, progress: Progress = lambda done, total, what: None
) -> MadeLog:
    """Write a log of one's own (docs/own-logs.md) from a bag.

    Args:
        path: file (MCAP or SQLite) or folder of the bag.
        out: folder to make; it is there whole or not at all.
        options: where a guess would be wrong.
        progress: of reading, in megabytes.

    Raises:
        UserError: ``out`` is there already, the bag lacks something, or what it holds is no drive.
    """
    options = options or BagOptions()
    bag, reader = Bag(path), Reader()
    with whole_folder(out) as draft:
        found = contents_of(bag, reader, _megabytes(progress, "MB looked through"))
        try:
            base = found.base_frame(options.base_frame)
            cameras, left_out = _cameras(bag, found, base, options.camera_topics)
            poses, source = found.poses(base, options.poses)
        except UserError as error:
            damage = "".join(f" Lost: {sentence}." for sentence in bag.damage)
            raise UserError(f"{path}: {error} Topics: {bag.listed_topics()}.{damage}") from None
        height = found.height(base) if options.height is None else options.height
        entries = {camera.name: camera.entry for camera in cameras}
        write_calibration(draft / CALIBRATION, entries, height or 0.0)
        write_timed_poses(draft / POSE_FILES[0], poses)
        lost = _write_images(bag, reader, found, cameras, draft, progress)
        check_made_log(draft, out, path)
        images = {name: len(list((draft / "images" / name).iterdir())) for name in entries}
    notes = [f"left out: {reason}" for reason in left_out]
    notes += [note for camera in cameras for note in camera.notes]
    if height is None:
        notes.append(f"{base} is taken to lie on the road; --height says how far above it is")
    notes += [f"{camera.info} changes in the course of the bag; its first message is used"
              for camera in cameras if camera.info in found.changing]  # fmt: skip
    notes += [
        f"{topic}: its headers have no time; the times of recording are used" for topic in sorted(found.unstamped)
    ]
    if found.graph.wrong:
        notes.append(f"{found.graph.wrong} transforms are no rigid motion and are left out")
    notes += [*(f"lost: {damage}" for damage in bag.damage), *lost]
    topics = {camera.name: camera.images.topic for camera in cameras}
    return MadeLog(topics, images, f"{source}, {count_and_rate(poses)}", notes, out)


def _cameras(bag: Bag, found: Contents, base: str, asked: Sequence[str]) -> tuple[list[BagCamera], list[str]]:
    unknown = [topic for topic in asked if topic not in found.images]
    if unknown:
        raise UserError(f"{', '.join(unknown)} is no image topic; there are: {', '.join(found.images) or 'none'}.")
    topics = [topic for name, topic in found.images.items() if not asked or name in asked]
    return cameras_of(topics, found.infos, found.graph, base, bool(asked))


def _write_images(
    bag: Bag, reader: Reader, found: Contents, cameras: Sequence[BagCamera], folder: Path, progress: Progress
) -> list[str]:
    """Write the images by camera and time, and return what was lost."""
    names = {camera.images.topic: camera.name for camera in cameras}
    kinds = {camera.images.kind for camera in cameras}
    for name in names.values():
        (folder / "images" / name).mkdir(parents=True)
    broken: dict[str, list[str]] = {topic: [] for topic in names}
    repeated: Counter[str] = Counter()
    for recorded in bag.messages(kinds, _megabytes(progress, "MB written")):
        if recorded.topic not in names:
            continue
        message = reader.message(recorded)
        if message is None:
            continue
        try:
            content, ending = image_file(message, recorded.kind)
        except UserError as error:
            broken[recorded.topic].append(str(error))
            continue
        path = folder / "images" / names[recorded.topic] / f"{found.time(message.header, recorded)}{ending}"
        repeated[recorded.topic] += path.exists()
        path.write_bytes(content)
    damaged = Counter({topic: len(reasons) for topic, reasons in broken.items()}) + reader.damaged
    lost = [f"lost: {count} damaged messages of {topic}{': ' + broken[topic][0] if broken.get(topic) else ''}"
            for topic, count in sorted(damaged.items())]  # fmt: skip
    return lost + [f"{topic}: {count} images have the time of another one, which they replace"
                   for topic, count in sorted(repeated.items()) if count]  # fmt: skip


def _megabytes(progress: Progress, what: str) -> BytesRead:
    """Return a callback that tells each megabyte once."""
    told = -1

    def read(done: int, total: int) -> None:
        nonlocal told
        if -(-done // 10**6) != told:
            told = -(-done // 10**6)
            progress(told, -(-total // 10**6), what)

    return read
