"""A number of iterations and a time budget, where both are asked for."""

import pytest

from turbogs_plugin.config.configuration import load_config, require_one_length
from turbogs_plugin.errors import InputError

BUDGET = "budget.time='9s'"


@pytest.fixture
def mine(tmp_path):
    """A configuration of the user's."""

    def write(text: str) -> str:
        (tmp_path / "mine.yaml").write_text(text)
        return str(tmp_path / "mine.yaml")

    return write


@pytest.mark.parametrize("overrides", [["train.iterations=2", BUDGET], ["train.iterations=2"], [BUDGET]])
def test_both_are_refused(mine, overrides):
    there = "train.iterations=2" in overrides
    text = "budget: {time: 9s}" if there else "train: {iterations: 2}"
    config = "turbogs" if len(overrides) == 2 else mine(f"base: demo\n{text}")
    of, remedy = ("", "leave one out") if there else (f" of '{config}'", "add train.iterations=auto, or leave the")
    said = f"^train.iterations=2{of} and the time budget 9s exclude each other: {remedy}"
    with pytest.raises(InputError, match=said):
        require_one_length(config, overrides)


@pytest.mark.parametrize(
    ("text", "overrides"),
    [
        ("base: demo", [BUDGET]),  # a packaged length
        ("train: {iterations: 2}", [BUDGET, "train.iterations=auto"]),
        ("budget: {time: 9s}", ["train.iterations=2", "budget.time=''"]),
        ("train: {iterations: 2}\nbudget: {time: 9s}", ["train.seed=1"]),  # as a run has written
    ],
)
def test_one_of_them_is_taken(mine, text, overrides):
    load_config(mine(text), overrides)
    require_one_length(mine(text), overrides)
