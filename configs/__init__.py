"""The configurations that come with TurboGS, as package data."""
