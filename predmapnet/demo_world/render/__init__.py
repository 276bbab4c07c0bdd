"""Camera images and lidar sweeps of a world."""
