"""Tables of a nuScenes data set, read only as far as mapping needs them.

``sample_data.json`` and ``ego_pose.json`` of v1.0-trainval hold 2.6 million records each, of which mapping wants
the key frames of one scene at a time. They are searched as bytes, and only the records asked for are parsed.
"""

from __future__ import annotations

import mmap
import re
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import orjson

from predmapnet.errors import UserError

Record = dict[str, Any]
LIDAR = "LIDAR_TOP"
NUSCENES_CAMERAS = ("CAM_FRONT", "CAM_FRONT_RIGHT", "CAM_FRONT_LEFT", "CAM_BACK", "CAM_BACK_LEFT", "CAM_BACK_RIGHT")
"""The cameras in the order of the official vector-map data sets."""

_KEY_FRAME = (b'"is_key_frame": true', b'"is_key_frame":true')
_SAMPLE_TOKEN = re.compile(rb'"sample_token"\s*:\s*"([^"]*)"')
_TOKEN = re.compile(rb'"token"\s*:\s*"([^"]*)"')


@dataclass(frozen=True)
class Tables:
    """One ``v1.0-*`` folder.

    Attributes:
        folder: of the tables.
    """

    folder: Path

    def read(self, table: str) -> list[Record]:
        """Parse a whole table. Raises UserError if it is missing or not JSON."""
        path = self.path(table)
        try:
            records = orjson.loads(path.read_bytes())
        except orjson.JSONDecodeError as error:
            raise UserError(f"{path} is not valid JSON ({error}). The file is damaged: fetch it again.") from None
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
        """Scene records by name, in file order."""
        return {_field(record, "name", "scene"): record for record in self.read("scene")}

    @cached_property
    def logs(self) -> dict[str, Record]:
        """Log records by token."""
        return _by_token(self.read("log"), "log")

    @cached_property
    def samples(self) -> dict[str, Record]:
        """Sample (key frame) records by token."""
        return _by_token(self.read("sample"), "sample")

    @cached_property
    def calibrations(self) -> dict[str, Record]:
        """Calibrated sensors by token, each with its ``channel``."""
        channels = {token: record["channel"] for token, record in _by_token(self.read("sensor"), "sensor").items()}
        records = _by_token(self.read("calibrated_sensor"), "calibrated_sensor")
        return {
            token: {**record, "channel": channels.get(record["sensor_token"], "")} for token, record in records.items()
        }

    @cached_property
    def _key_frame_spans(self) -> dict[bytes, list[tuple[int, int]]]:
        """Byte ranges of each sample's key-frame records in ``sample_data.json``, radars left out."""
        spans: dict[bytes, list[tuple[int, int]]] = {}
        with _mapped(self.path("sample_data")) as data:
            for start, end in _records_with(data, _KEY_FRAME):
                record = data[start:end]
                token = _SAMPLE_TOKEN.search(record)
                if token is not None and b"RADAR" not in record:
                    spans.setdefault(token.group(1), []).append((start, end))
        return spans

    def sample_data(self, sample_tokens: Iterable[str]) -> dict[str, dict[str, Record]]:
        """Return the key-frame ``sample_data`` records of some samples, by sample token and channel."""
        path = self.path("sample_data")
        result: dict[str, dict[str, Record]] = {}
        with _mapped(path) as data:
            for token in sample_tokens:
                spans = self._key_frame_spans.get(token.encode(), [])
                records = [_parse(data[start:end], path) for start, end in spans]
                result[token] = {self._channel(record, path): record for record in records}
        return result

    def _channel(self, record: Record, path: Path) -> str:
        calibration = self.calibrations.get(record.get("calibrated_sensor_token", ""))
        if calibration is None:
            raise UserError(f"{path}: record {record.get('token')} names a calibrated sensor that does not exist.")
        return str(calibration["channel"])

    @cached_property
    def _pose_offsets(self) -> dict[bytes, int]:
        """Byte offsets of the records of the lidar's key frames in ``ego_pose.json``."""
        with _mapped(self.path("sample_data")) as data:
            wanted = {
                match.group(1)
                for spans in self._key_frame_spans.values()
                for start, end in spans
                if (match := re.search(rb'"ego_pose_token"\s*:\s*"([^"]*)"', data[start:end])) is not None
            }
        with _mapped(self.path("ego_pose")) as data:
            return {match.group(1): match.start() for match in _TOKEN.finditer(data) if match.group(1) in wanted}

    def ego_poses(self, tokens: Iterable[str]) -> dict[str, Record]:
        """Return ``ego_pose`` records by token; tokens that the table lacks are absent."""
        path = self.path("ego_pose")
        result: dict[str, Record] = {}
        with _mapped(path) as data:
            for token in tokens:
                offset = self._pose_offsets.get(token.encode())
                if offset is not None:
                    result[token] = _parse(data[data.rfind(b"{", 0, offset) : data.find(b"}", offset) + 1], path)
        return result


def _field(record: Mapping[str, Any], name: str, table: str) -> Any:
    if name not in record:
        raise UserError(f"A record of {table}.json has no field '{name}': {dict(record)}.")
    return record[name]


def _by_token(records: list[Record], table: str) -> dict[str, Record]:
    return {_field(record, "token", table): record for record in records}


def _parse(text: bytes, path: Path) -> Record:
    try:
        # The tables of other tools may hold NaN, which is not JSON; null lets the pose check name the frame.
        record: Record = orjson.loads(re.sub(rb"\b(?:NaN|-?Infinity)\b", b"null", text))
    except orjson.JSONDecodeError as error:
        excerpt = text[:120].decode(errors="replace")
        raise UserError(f"{path} holds a record that is not valid JSON ({error}): {excerpt}") from None
    return record


def _records_with(data: mmap.mmap, needles: tuple[bytes, ...]) -> Iterator[tuple[int, int]]:
    """Yield the byte range of every flat record that contains one of the needles, in file order for each needle."""
    for needle in needles:
        position = data.find(needle)
        while position >= 0:
            end = data.find(b"}", position) + 1
            if end == 0:
                return
            yield data.rfind(b"{", 0, position), end
            position = data.find(needle, end)


@contextmanager
def _mapped(path: Path) -> Iterator[mmap.mmap]:
    """Map a file into memory for reading."""
    if path.stat().st_size == 0:
        raise UserError(f"{path} is empty. The file is damaged: fetch it again.")
    with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
        yield data
