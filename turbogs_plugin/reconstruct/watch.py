"""Long steps of pycolmap: in a thread, with a bar on a terminal, and stopped by Ctrl-C."""

from __future__ import annotations

import sqlite3
import sys
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future, wait
from contextlib import closing, nullcontext, suppress
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

if TYPE_CHECKING:
    import pycolmap
    from rich.progress import Progress

POLL_SECONDS = 0.2

Result = TypeVar("Result")


def watched(
    title: str, total: int | None, done: Callable[[], int], step: Callable[[pycolmap.CancellationToken], Result]
) -> Result:
    """Run a step that does not return to Python for minutes.

    On a terminal a bar follows it; elsewhere one line on stderr says at the end what was done, and in which time.

    Args:
        title: of the step.
        total: what `done` will say at the end; None where it is not known.
        done: how far the step is; called from time to time.
        step: is given a token by which it can be stopped.

    Raises:
        KeyboardInterrupt: after the step has stopped; what it had finished is kept.
    """
    from turbogs_plugin.captures.colmap import load_pycolmap

    token = load_pycolmap().CancellationToken()
    outcome: Future[Result] = Future()

    def run() -> None:
        try:
            outcome.set_result(step(token))
        except BaseException as error:  # handed to the thread that waits
            outcome.set_exception(error)

    start = time.monotonic()
    thread = threading.Thread(target=run, daemon=True)
    bar = _bar()
    with nullcontext() if bar is None else bar:
        task = None if bar is None else bar.add_task(title, total=total)
        try:
            thread.start()
            ended = False
            while not ended:
                ended = bool(wait([outcome], POLL_SECONDS).done)
                if bar is not None:
                    bar.update(task, completed=done())
        except KeyboardInterrupt:
            token.cancel()
            if thread.ident is not None:  # or it has not begun
                wait([outcome])
            raise
    result = outcome.result()
    if bar is None:
        print(f"{title}: {done():,} in {time.monotonic() - start:.1f} s", file=sys.stderr, flush=True)
    return result


def row_counter(database: Path, table: str) -> Callable[[], int]:
    """A function that counts the rows of a table while another thread writes to the database."""
    latest = 0

    def count() -> int:
        nonlocal latest
        place = f"{database.absolute().as_uri()}?mode=ro"
        # It may not be there yet, or be locked just now.
        with suppress(sqlite3.Error), closing(sqlite3.connect(place, uri=True, timeout=0.1)) as connection:
            (latest,) = connection.execute(f"SELECT COUNT(*) FROM {table}").fetchone()
        return latest

    return count


def _bar() -> Progress | None:
    if not sys.stderr.isatty():
        return None
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    return Progress(*columns, console=Console(stderr=True))
