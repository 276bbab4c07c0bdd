"""Losses, matching, clips and the stages of training."""
