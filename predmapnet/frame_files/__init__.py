"""Readers and writers of per-frame results and poses."""
