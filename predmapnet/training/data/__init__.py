"""Frames, truth and augmentation for training."""
