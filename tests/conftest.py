"""What all tests share."""

import sys

import pytest
import torch

from turbogs_plugin import cli

torch.set_num_threads(1)  # the tests' tensors are small: more threads gain nothing and collapse on a busy machine


@pytest.fixture
def turbogs(monkeypatch, capsys):
    """Run the command in this process: (exit code, stdout, stderr)."""

    def turbogs(*arguments) -> tuple[int, str, str]:
        monkeypatch.setattr(sys, "argv", ["turbogs", *map(str, arguments)])
        with pytest.raises(SystemExit) as end:
            cli.main()
        captured = capsys.readouterr()
        return end.value.code or 0, captured.out, captured.err

    return turbogs
