"""The configuration of a run: dataclasses <- YAML <- dotted overrides."""
