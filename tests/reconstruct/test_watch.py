"""Steps in a thread: their results, their errors, and what Ctrl-C does."""

import _thread
import signal
import sqlite3
import threading

import pytest

from turbogs_plugin.reconstruct.watch import row_counter, watched


def test_a_step_gives_its_result_and_a_line(capsys):
    assert watched("photos counted", 3, lambda: 3, lambda token: "done") == "done"
    assert capsys.readouterr().err.startswith("photos counted: 3 in ")


def test_the_error_of_a_step_is_raised_where_it_is_waited_for():
    def fail(token) -> None:
        raise ValueError("no photo")

    with pytest.raises(ValueError, match="no photo"):
        watched("photos", None, lambda: 0, fail)


def test_a_stop_waits_for_the_step_to_end():
    ended = threading.Event()

    def endless(token) -> None:
        _thread.interrupt_main()
        while not token.is_cancelled:
            pass
        ended.set()

    before = signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's job in the background ignores it
    try:
        with pytest.raises(KeyboardInterrupt):
            watched("photos", None, lambda: 0, endless)
    finally:
        signal.signal(signal.SIGINT, before)
    assert ended.is_set()


def test_rows_are_counted_while_there_is_no_table_too(tmp_path):
    database = tmp_path / "a database.db"
    count = row_counter(database, "photos")
    assert count() == 0 and not database.exists()
    with sqlite3.connect(database) as connection:
        connection.execute("CREATE TABLE photos (name)")
        connection.executemany("INSERT INTO photos VALUES (?)", [("a",), ("b",)])
    assert count() == 2
    database.unlink()
    assert count() == 2  # as it was last seen
