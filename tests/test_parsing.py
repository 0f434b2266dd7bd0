"""Words of the command line that no command takes: one line each, with what to do."""

import sys

import pytest

from turbogs_plugin.commands.parsing import parsed, refusal_line
from turbogs_plugin.errors import InputError


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("trian x --out y", ("no such command 'trian': did you mean 'train'? (known: ablate, bench, ",)),
        ("", ("Expected one of {train, ", "see turbogs --help")),
        ("train s --out r --fctor 3", ("Unrecognized options: --fctor, 3; did you mean --factor?",)),
        (
            "train s --out r --steps 3",
            ("Unrecognized options of turbogs train: --steps, 3; turbogs ablate takes --steps",),
        ),
        (
            "render r --seeds 4 --fctor 3",
            ("turbogs render: --seeds, 4, --fctor, 3; did you mean --factor?; turbogs ablate takes --seeds",),
        ),
        ("eval r --out x", ("Unrecognized options of turbogs eval: --out, x;", "see turbogs eval --help\n")),
        ("train s --out r --factor abc", ("--factor 'abc': it takes an integer; see turbogs --help",)),
        ("train s --out r --device tpu", ("'tpu' for argument '--device'", "'cuda'", "see turbogs train --help")),
        ("train s --out", ("Missing value for argument '--out'", "see turbogs train --help")),
        ("eval", ("Missing from turbogs eval: RUN|MODEL; see turbogs eval --help",)),
        ("bench", ("Missing from turbogs bench: step|ranks|raster|",)),
        ("ablate parts --seeds 0", ("Missing from turbogs ablate: --out PATH; see",)),
        ("ablate parts --out s --seeds a b", ("--seeds", "['a', 'b']")),
    ],
)
def test_words_that_no_command_takes_are_refused_in_a_line(turbogs, words, said):
    code, out, err = turbogs(*words.split())
    assert (code, out) == (2, "") and err.startswith("turbogs: error: ") and err.count("\n") == 1
    assert all(part in err for part in said), err


def test_a_refusal_without_a_box_is_told_as_it_is():
    assert refusal_line("It is\n not this.\n") == "It is not this"


def test_what_is_called_is_called_afterwards(capsys):
    """A command's own words, and its own end, are no refusal."""

    def command(number: int) -> int:
        print(number, file=sys.stderr)
        sys.exit(2)

    call = parsed({"one": command, "other": command}, ["one", "--number", "3"], "")
    assert capsys.readouterr().err == ""
    with pytest.raises(SystemExit):
        call()
    assert capsys.readouterr().err == "3\n"
    with pytest.raises(InputError, match=r"--number: .*'x'"):
        parsed({"one": command, "other": command}, ["one", "--number", "x"], "")


def test_help_is_printed_whole(capsys):
    def command(number: int) -> int:
        """Does one thing."""

    with pytest.raises(SystemExit) as end:
        parsed({"one": command, "other": command}, ["one", "--help"], "")
    assert end.value.code == 0 and "Does one thing." in capsys.readouterr().out
