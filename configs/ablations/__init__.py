"""The ablation tables that come with TurboGS, as package data."""
