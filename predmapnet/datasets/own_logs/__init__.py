"""Logs of one's own, as plain files: images by camera and time stamp, one calibration, one file of poses."""
