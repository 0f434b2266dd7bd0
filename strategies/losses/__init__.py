"""Losses on sampled pixels."""
