"""Tables of a nuScenes data set, read only as far as mapping needs them.

``sample_data.json`` and ``ego_pose.json`` of v1.0-trainval hold 2.6 million records each, of which mapping wants the
key frames of the cameras and the lidar. The tables are parsed in pieces, and only those are kept.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

from predmapnet.datasets.fields import text_field
from predmapnet.datasets.large_tables import Mark, Record, parse_json, select_records
from predmapnet.errors import UserError
from predmapnet.files import file_name

LIDAR = "LIDAR_TOP"
NUSCENES_CAMERAS = ("CAM_FRONT", "CAM_FRONT_RIGHT", "CAM_FRONT_LEFT", "CAM_BACK", "CAM_BACK_LEFT", "CAM_BACK_RIGHT")
"""The cameras in the order of the official vector-map data sets."""

_KEY_FRAME = re.compile(rb'"is_key_frame"\s*:\s*(true|false)')
_TOKEN = re.compile(rb'"token"\s*:\s*"([^"]*)"')


def find_versions(root: Path) -> tuple[str, ...]:
    """Return the names of the ``v1.0-*`` table folders below ``root``, sorted."""
    return tuple(sorted(path.parent.name for path in root.glob("v1.0-*/scene.json")))


def choose_version(root: Path, version: str | None) -> str:
    """Return the table folder to open: the given one, or else trainval before others, mini only when alone.

    Raises UserError where there is none, not that one, or several without a clear first choice.
    """
    if not root.is_dir():
        raise UserError(f"The nuScenes folder {root} does not exist.")
    versions = find_versions(root)
    if not versions:
        raise UserError(
            f"{root} holds no nuScenes tables: looked for folders v1.0-*/ with scene.json in them. "
            "The data root is the folder that contains v1.0-trainval (or v1.0-mini), samples and maps."
        )
    if version is not None:
        if version not in versions:
            raise UserError(f"{root} holds no nuScenes version '{version}'; found: {', '.join(versions)}.")
        return version
    if "v1.0-trainval" in versions:
        return "v1.0-trainval"
    others = [name for name in versions if name != "v1.0-mini"] or ["v1.0-mini"]
    if len(others) > 1:
        raise UserError(f"{root} holds several nuScenes versions ({', '.join(versions)}): say which one to open.")
    return others[0]


def expansion_path(root: Path, location: str) -> Path:
    """Return where the map expansion of a location lies; the name comes from a table and must not lead elsewhere."""
    return root / "maps" / "expansion" / f"{file_name(location)}.json"


class SensorData(NamedTuple):
    """Key-frame record of ``sample_data.json``; None where a field is missing, so that its reader can say so."""

    token: Any
    ego_pose_token: Any
    calibrated_sensor_token: Any
    filename: Any
    width: Any
    height: Any


@dataclass(frozen=True)
class Tables:
    """One ``v1.0-*`` folder of tables."""

    folder: Path

    def read(self, table: str) -> list[Record]:
        """Parse a whole table. Raises UserError if it is missing or not a table."""
        path = self.path(table)
        records = parse_json(path.read_bytes(), path)
        if not isinstance(records, list) or not all(isinstance(record, dict) for record in records):
            raise UserError(f"{path} is not a nuScenes table: it must be a list of records.")
        return records

    def path(self, table: str) -> Path:
        """Return the file of a table. Raises UserError if it does not exist."""
        path = self.folder / f"{table}.json"
        if not path.is_file():
            raise UserError(f"{path} does not exist. Is {self.folder.parent} a complete nuScenes data set?")
        return path

    @cached_property
    def scenes(self) -> dict[str, Record]:
        """Scene records by name, in file order; a name that comes again is told apart by a number."""
        path = self.path("scene")
        scenes: dict[str, Record] = {}
        for record in self.read("scene"):
            name = unique = text_field(record, "name", str(path))
            number = 1
            while unique in scenes:
                number += 1
                unique = f"{name} ({number})"
            scenes[unique] = record
        return scenes

    @cached_property
    def logs(self) -> dict[str, Record]:
        """Log records by token."""
        return self._by_token("log")

    @cached_property
    def samples(self) -> dict[str, Record]:
        """Sample (key frame) records by token."""
        return self._by_token("sample")

    @cached_property
    def calibrations(self) -> dict[str, Record]:
        """Calibrated sensors by token, each with its ``channel``."""
        sensors, where = self._by_token("sensor"), str(self.path("sensor"))
        channels = {token: text_field(record, "channel", where) for token, record in sensors.items()}
        where = str(self.path("calibrated_sensor"))
        return {
            token: {**record, "channel": channels.get(text_field(record, "sensor_token", where), "")}
            for token, record in self._by_token("calibrated_sensor").items()
        }

    def _by_token(self, table: str) -> dict[str, Record]:
        where = str(self.path(table))
        found: dict[str, Record] = {}
        for record in self.read(table):
            token = text_field(record, "token", where)
            if found.setdefault(token, record) != record:
                raise UserError(
                    f"{where}: two different records have the token {token[:60]}. Which is right? Keep one."
                )
        return found

    @cached_property
    def _key_frames(self) -> dict[str, dict[str, SensorData]]:
        """Key-frame records of the lidar and of all cameras, by sample token and channel."""
        path = self.path("sample_data")
        calibrations = self.calibrations
        channels = {
            token: calibration["channel"]
            for token, calibration in calibrations.items()
            if "RADAR" not in calibration["channel"]
        }
        result: dict[str, dict[str, SensorData]] = {}

        def keep(record: Record) -> None:
            flag = record.get("is_key_frame")
            if not isinstance(flag, int) or flag not in (0, 1):  # true and false are integers, too
                raise UserError(
                    f"{path}, record {record.get('token')}: the field 'is_key_frame' must be true or false, not {flag}."
                )
            if not flag:
                return
            calibration = text_field(record, "calibrated_sensor_token", str(path))
            if calibration not in calibrations:
                raise UserError(f"{path}: record {record.get('token')} names a calibrated sensor that does not exist.")
            if calibration in channels:
                sample = text_field(record, "sample_token", str(path))
                data, channel = SensorData(*map(record.get, SensorData._fields)), channels[calibration]
                if result.setdefault(sample, {}).setdefault(channel, data) != data:
                    raise UserError(f"{path}: sample {sample[:60]} has two key frames of {channel}. Which is right?")

        select_records(path, keep, Mark(_KEY_FRAME, {b"true"}.__contains__))
        return result

    def sample_data(self, sample_tokens: Iterable[str]) -> dict[str, dict[str, Record]]:
        """Return the key-frame ``sample_data`` records of some samples, by sample token and channel."""
        return {
            token: {channel: data._asdict() for channel, data in self._key_frames.get(token, {}).items()}
            for token in sample_tokens
        }

    @cached_property
    def _lidar_poses(self) -> dict[str, Record]:
        """Records of ``ego_pose.json`` at the lidar's key frames, by token."""
        lidars = (sensors[LIDAR].ego_pose_token for sensors in self._key_frames.values() if LIDAR in sensors)
        wanted = {token for token in lidars if isinstance(token, str)}
        path = self.path("ego_pose")

        def keep(record: Record) -> Record | None:
            token = record.get("token")
            return record if isinstance(token, str) and token in wanted else None

        encoded = {token.encode() for token in wanted}
        records = select_records(path, keep, Mark(_TOKEN, encoded.__contains__))
        return {record["token"]: record for record in records}

    def ego_poses(self, tokens: Iterable[str]) -> dict[str, Record]:
        """Return ``ego_pose`` records of the lidar's key frames by token; tokens that the table lacks are absent."""
        return {token: self._lidar_poses[token] for token in tokens if token in self._lidar_poses}
