"""Writes a log with py123d's own writers from numbers on the command line: folder, codec, and a JSON file of a log.

The JSON has ``height`` of the ego origin above the road, ``poses`` (microseconds, x, y, z, qw, qx, qy, qz) and
``cameras``: width, height, intrinsics, distortion, pose, and ``images`` (microseconds, path).
"""

import json
import sys
from pathlib import Path

from py123d.api.scene.arrow.modalities.arrow_camera import ArrowCameraWriter
from py123d.api.scene.arrow.modalities.arrow_ego_state_se3 import ArrowEgoStateSE3Writer
from py123d.datatypes import Timestamp
from py123d.datatypes.sensors.base_camera import CameraID
from py123d.datatypes.sensors.pinhole_camera import PinholeCameraMetadata, PinholeDistortion, PinholeIntrinsics
from py123d.datatypes.vehicle_state.ego_state import EgoStateSE3
from py123d.datatypes.vehicle_state.ego_state_metadata import EgoStateSE3Metadata
from py123d.geometry import PoseSE3
from py123d.parser.base_dataset_parser import ParsedCamera

folder, codec, log = Path(sys.argv[1]), sys.argv[2], json.loads(Path(sys.argv[3]).read_text())
folder.mkdir(parents=True)
centre = PoseSE3.from_list([1.4, 0.0, 0.9 - log["height"], 1.0, 0.0, 0.0, 0.0])
rear = PoseSE3.from_list([0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0])
car = EgoStateSE3Metadata("car", 1.9, 4.6, 1.8, 2.8, centre, rear)
writer = ArrowEgoStateSE3Writer(folder, car)
for time, *pose in log["poses"]:
    writer.write_modality(EgoStateSE3.from_imu(PoseSE3.from_list(pose), car, Timestamp.from_us(time)))
writer.close()
for number, camera in zip((CameraID.PCAM_F0, CameraID.PCAM_L0), log["cameras"].values(), strict=True):
    metadata = PinholeCameraMetadata(
        "any name",
        number,
        PinholeIntrinsics(*camera["intrinsics"]),
        None if camera["distortion"] is None else PinholeDistortion(*camera["distortion"]),
        camera["width"],
        camera["height"],
        PoseSE3.from_list(camera["pose"]),
    )
    writer = ArrowCameraWriter(folder, metadata, camera_codec=codec)
    for time, path in camera["images"]:
        parsed = ParsedCamera(
            metadata,
            Timestamp.from_us(time),
            PoseSE3.from_list(camera["pose"]),
            dataset_root=Path(path).parent,
            relative_path=Path(path).name,
        )
        writer.write_modality(parsed)
    writer.close()
print(json.dumps(sorted(path.name for path in folder.iterdir())))
