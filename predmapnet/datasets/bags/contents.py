"""Contents of a bag beside its images: camera infos, transforms, odometry, and the first image of each topic."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from functools import cache
from typing import Any

import numpy as np

from predmapnet.datasets.bags.cameras import ImageTopic
from predmapnet.datasets.bags.frame_graph import FrameGraph
from predmapnet.datasets.bags.image_messages import COMPRESSED, RAW, image_size
from predmapnet.datasets.bags.storage import Bag, BytesRead, Recorded
from predmapnet.datasets.own_logs.timed_poses import TimedPoses
from predmapnet.errors import UserError

CAMERA_INFO, TRANSFORMS, ODOMETRY = "sensor_msgs/msg/CameraInfo", "tf2_msgs/msg/TFMessage", "nav_msgs/msg/Odometry"
KINDS = (COMPRESSED, RAW, CAMERA_INFO, TRANSFORMS, ODOMETRY)

BASES = ("base_link", "base_footprint", "ego_vehicle", "vehicle", "ego", "body")
"""Customary names of the car's frame, the likeliest first."""
FOOTPRINT = "base_footprint"
"""Frame on the ground, by convention."""
TRIED = 10
"""Images of a topic that are looked at until one can be decoded."""
FIXED = ("map", "world", "odom")
"""Customary names of frames that stay where they are, the best first."""


class Reader:
    """Messages as objects; those that are damaged are counted.

    The standard definitions of the few types that are read have been the same in all editions of ROS 2, so those in the
    bag, from which code would be made, are left alone.
    """

    def __init__(self) -> None:
        self._store = _standard_types()
        self.damaged: Counter[str] = Counter()

    def message(self, recorded: Recorded) -> Any | None:
        """Return a message as an object, or None if it is damaged."""
        from rosbags.serde import SerdeError

        try:
            return self._store.deserialize_cdr(recorded.data, recorded.kind)
        except (SerdeError, MemoryError):  # a length may be anything
            self.damaged[recorded.topic] += 1
            return None


@cache
def _standard_types() -> Any:
    from rosbags.typesys import Stores, get_typestore

    return get_typestore(Stores.ROS2_HUMBLE)


@dataclass
class Contents:
    """Findings in a bag.

    Attributes:
        graph: frames and the transforms between them.
        odometry: of each odometry topic, its frame, the frame that it tells of, and its graph.
        infos: first camera info of each topic.
        images: image topics by name.
        changing: camera infos that say different things in the course of the bag.
        unstamped: topics whose headers have no time; the time of recording is taken.
    """

    graph: FrameGraph = field(default_factory=FrameGraph)
    odometry: dict[str, tuple[str, str, FrameGraph]] = field(default_factory=dict)
    infos: dict[str, Any] = field(default_factory=dict)
    images: dict[str, ImageTopic] = field(default_factory=dict)
    changing: set[str] = field(default_factory=set)
    unstamped: set[str] = field(default_factory=set)

    def time(self, header: Any, recorded: Recorded) -> int:
        """Return when a message was true, nanoseconds."""
        stamp = int(header.stamp.sec) * 1_000_000_000 + int(header.stamp.nanosec)
        if not stamp and not recorded.topic.endswith("tf_static"):
            self.unstamped.add(recorded.topic)
        return stamp or recorded.received

    def base_frame(self, asked: str | None) -> str:
        """Return the frame of the car. Raises UserError: it is not there, or has no customary name."""
        known = {*self.graph.frames, *(child for _, child, _ in self.odometry.values() if child)}
        if asked is not None:
            if asked.strip("/") not in known:
                raise UserError(f"The bag has no frame {asked}; there are: {', '.join(sorted(known)) or 'none'}.")
            return asked.strip("/")
        customary = [frame for name in BASES for frame in sorted(known) if frame.rpartition("/")[2] == name]
        if customary:
            return customary[0]
        told = {child for _, child, _ in self.odometry.values() if child}
        if len(told) == 1:
            return told.pop()
        raise UserError(
            f"Which frame is the car's? None is called {', '.join(BASES)}. Name it with --base-frame; there are: "
            f"{', '.join(sorted(known)) or 'none (were /tf and /tf_static recorded?)'}."
        )

    def poses(self, base: str, asked: str | None) -> tuple[TimedPoses, str]:
        """Return where the car was, and a sentence of what says so.

        Args:
            base: frame of the car.
            asked: an odometry topic, or the frame that the poses shall be in; None prefers transforms to odometry.

        Raises:
            UserError: nothing of the kind is there.
        """
        frames = self.graph.frames
        roots = [frame for frame in frames if not any(frame == child for _, child in self.graph.links)]
        fixed = [asked.strip("/")] if asked else [*(frame for frame in FIXED if frame in frames), *roots]
        if asked not in self.odometry:
            for frame in fixed:
                drive = self.graph.drive(base, frame)
                if drive is not None:
                    return drive, f"transforms from {base} to {frame}"
        topics = [asked] if asked in self.odometry else [] if asked else sorted(self.odometry, key=self._preference)
        for topic in topics:
            frame, child, graph = self.odometry[topic]
            drive = graph.drive(child, frame)
            if drive is not None:
                mounting = self.graph.mounting(base, child) if child not in ("", base) else np.eye(4)
                poses = np.asarray(drive.ego_to_global @ mounting)
                return TimedPoses(drive.timestamps, poses), f"odometry {topic} of {child or base} in {frame}"
        raise UserError(
            f"Nothing says where {base} was{f' ({asked})' if asked else ''}: it moves against none of the frames "
            f"{', '.join(fixed) or FIXED[0]}, and no odometry tells of it or of something fixed to it. --poses names a "
            f"frame or topic. Frames: {', '.join(frames) or 'none'}; odometry: {', '.join(self.odometry) or 'none'}."
        )

    def _preference(self, topic: str) -> tuple[bool, int, str]:
        frame, _, graph = self.odometry[topic]
        count = max((len(poses.timestamps) for poses in graph.links.values()), default=0)
        return frame != FIXED[0], -count, topic

    def height(self, base: str) -> float | None:
        """Return how far the car's frame is above the road, metres; None if no frame on the ground is known."""
        if base == FOOTPRINT:
            return 0.0
        try:
            return -float(self.graph.mounting(FOOTPRINT, base)[2, 3])
        except UserError:
            return None


def contents_of(bag: Bag, reader: Reader, progress: BytesRead) -> Contents:
    """Read all but the images of a bag."""
    found = Contents()
    for recorded in bag.messages(KINDS, progress):
        known = found.images.get(recorded.topic)
        if known is not None and (known.size or bag.counts[recorded.topic] > TRIED):
            continue
        message = reader.message(recorded)
        if message is None:
            continue
        if recorded.kind in (COMPRESSED, RAW):
            found.images[recorded.topic] = _image_topic(recorded, message)
        elif recorded.kind == CAMERA_INFO:
            first = found.infos.setdefault(recorded.topic, message)
            if (*first.k, *first.d, first.width) != (*message.k, *message.d, message.width):
                found.changing.add(recorded.topic)
        elif recorded.kind == TRANSFORMS:
            for stamped in message.transforms:
                t, q = stamped.transform.translation, stamped.transform.rotation
                time, pose = found.time(stamped.header, recorded), (t.x, t.y, t.z, q.x, q.y, q.z, q.w)
                found.graph.add(stamped.header.frame_id, stamped.child_frame_id, time, pose)
        else:
            frame, child = message.header.frame_id.strip("/"), message.child_frame_id.strip("/")
            graph = found.odometry.setdefault(recorded.topic, (frame, child, FrameGraph()))[2]
            p, q = message.pose.pose.position, message.pose.pose.orientation
            pose = (p.x, p.y, p.z, q.x, q.y, q.z, q.w)
            graph.add(frame, child, found.time(message.header, recorded), pose)
    # Images are read again.
    for topic in found.images:
        reader.damaged.pop(topic, None)
    return found


def _image_topic(recorded: Recorded, message: Any) -> ImageTopic:
    size, problem = None, ""
    try:
        size = image_size(message, recorded.kind)
    except UserError as error:
        problem = str(error)
    return ImageTopic(recorded.topic, recorded.kind, message.header.frame_id.strip("/"), size, problem)
