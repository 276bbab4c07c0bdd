"""Recordings of runs and maps for the Rerun viewer."""

from predmapnet.recording.file_sink import RecordingFile
from predmapnet.recording.frames_view import log_frames
from predmapnet.recording.map_view import log_changes, log_differences, log_maps
from predmapnet.recording.recorder import APPLICATION, SceneRecorder

__all__ = ["APPLICATION", "RecordingFile", "SceneRecorder", "log_changes", "log_differences", "log_frames", "log_maps"]
