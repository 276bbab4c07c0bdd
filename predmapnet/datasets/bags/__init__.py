"""ROS 2 recordings (MCAP and SQLite) as logs of one's own; no ROS is needed."""
