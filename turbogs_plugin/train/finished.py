"""Runs that have come to their end: what is said of them in the place of going on."""

from __future__ import annotations

from turbogs_plugin.errors import InputError
from turbogs_plugin.train.checkpoint import latest_checkpoint, load_checkpoint
from turbogs_plugin.train.folder import RunFolder


def finished_text(folder: RunFolder, reported: bool) -> str:
    """``RUN is finished: N of N iterations`` where nothing of a run is left to do, else "".

    Args:
        reported: whether its report is asked for.
    """
    if not folder.model.is_file() or (reported and not folder.report.is_file()):
        return ""
    config, checkpoint = folder.read_config(), latest_checkpoint(folder.checkpoints)
    if checkpoint is None:
        return ""
    state = load_checkpoint(checkpoint)
    try:
        iteration = state["trainer"]["iteration"]
        total = state["pace"].get("iterations", config.train.iterations)  # with a time budget the pace knows better
        return f"{folder.path} is finished: {iteration} of {total} iterations" if iteration >= total else ""
    except (KeyError, TypeError, AttributeError):
        return ""  # whoever goes on by this checkpoint says what is wrong with it


def require_unfinished(folder: RunFolder) -> None:
    """Raise `InputError` where a run without a checkpoint has its model: to train anew would replace its history."""
    if folder.model.is_file():
        raise InputError(
            f"'{folder.path}' is finished, for its {folder.model.name} is there, and has no checkpoint to go on from: "
            "use that model, or train anew with another --out"
        )
