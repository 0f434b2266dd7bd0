"""Strategies that plug into TurboGS by entry point."""
