"""Frames of any data set at the image size of a network, kept on disk with their truth."""
