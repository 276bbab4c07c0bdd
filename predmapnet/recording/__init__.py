"""The bridge to Rerun: a run of the mapper as a recording that a person understands at once."""

from predmapnet.recording.file_sink import RecordingFile
from predmapnet.recording.map_view import log_map_file
from predmapnet.recording.recorder import APPLICATION, SceneRecorder

__all__ = ["APPLICATION", "RecordingFile", "SceneRecorder", "log_map_file"]
