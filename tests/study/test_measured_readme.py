"""`make results`: what it measures and in which order, what a further call does, and that README shows nothing else."""

import importlib
import json
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import tyro
from helpers.framework_runs import tiny_capture, tiny_settings
from PIL import Image

from turbogs_plugin.bench import commands as bench_commands
from turbogs_plugin.report.provenance import COMMIT_VARIABLE
from turbogs_plugin.study import commands as study_commands
from turbogs_plugin.study.grid import load_ablation
from turbogs_plugin.study.workers import UNFINISHED

ROOT = Path(__file__).parents[2]
sys.path[:0] = [str(ROOT / "docs"), str(ROOT / "examples")]  # the scripts import their neighbours
demo_picture, make_pages, make_pictures, measure_readme, pixels_on_an_mlp, study_tables = (
    importlib.import_module(name)
    for name in ("demo_picture", "make_pages", "make_pictures", "measure_readme", "pixels_on_an_mlp", "study_tables")
)
OTHERS = {"docs/results/peers.json"}
"""What README's tables have of the others' own code."""
SECONDS = {
    "ablate": 7,
    "wall": 40,
    "train": 15,
    "make_pictures.py": 15,
    "demo_picture.py": 1,
    "pixels_on_an_mlp.py": 50,
}
"""What commands take by the clock of `Machine`; an ablation, for each cell."""
WALLS = ["wall fox", "wall caliterra", "wall snowmiku"]
WALLS = [*WALLS, *WALLS, "wall fox", *WALLS]
"""Of the stage wall: of turbogs-ssim, turbogs-small (on fox with two caps) and turbogs."""


class Machine:
    """Runs commands in this process: those of studies and of the wall are stood in for, the others made short.

    Attributes:
        now: seconds on its clock.
        begun: what was called, in order; an ablation with the number of its cells.
        broken: a command with this word fails.
        capture: stands in for the demo's.
    """

    def __init__(self, turbogs, monkeypatch, capture: Path) -> None:
        self.turbogs, self.monkeypatch = turbogs, monkeypatch
        self.now, self.broken = 0.0, "nothing"
        self.begun: list[str] = []
        self.capture = capture
        monkeypatch.setattr(measure_readme, "run", self.run)
        monkeypatch.setattr(measure_readme, "monotonic", lambda: self.now)
        monkeypatch.setattr(study_commands, "ablate", self.ablate)
        monkeypatch.setattr(bench_commands, "run_wall", self.wall)

    def run(self, words: list[str | Path]) -> int:
        words = [str(word) for word in words]
        if self.broken in words:
            return 1
        if words[:3] == ["-m", "turbogs_plugin.cli", "demo"]:
            shutil.copytree(self.capture, words[3])
            return 0
        if words[:2] == ["-m", "turbogs_plugin.cli"]:
            short = [*tiny_settings(), "--device", "cpu"] if words[2] == "train" else []
            self.took("train" if short else None)
            code, _, err = self.turbogs(*words[2:], *short)
            assert code in (0, UNFINISHED), err
            return code
        script = Path(words[0]).name
        assert (ROOT / words[0]).is_file()
        self.took(script)
        if script == "make_pictures.py":
            assert words[2] == "44"
            self.monkeypatch.setattr(sys, "argv", [script, words[1], "0", words[3]])  # of seven views
            make_pictures.main()
        elif script == "demo_picture.py":
            self.monkeypatch.setattr(sys, "argv", words)
            demo_picture.main()
        else:
            tyro.cli(pixels_on_an_mlp.main, args=[*words[1:], "--iterations", "1", "--seeds", "0"])
        return 0

    def took(self, command: str | None, what: str = "") -> None:
        if command:
            self.now += SECONDS[command]
            self.begun.append(f"{command} {what}".strip())

    def wall(self, arguments, repeats, device, out: Path) -> None:
        changed = any("=" in word for word in arguments)
        assert repeats == (1 if changed else 3), "turbogs has a table"
        self.took("wall", Path(arguments[0]).name)
        out.write_text(json.dumps({"of": arguments[0]}))

    def ablate(self, names, options, out: Path, only, targets) -> int:
        """Keeps in a file how many cells are there, and takes the results that docs/ has in the end, if any."""
        begun = self.now
        for name in names:
            folder = out if len(names) == 1 else out / name
            folder.mkdir(parents=True, exist_ok=True)
            there = {line for line in (folder / "cells").read_text().split()} if (folder / "cells").exists() else set()
            wanted = {
                f"{scene.name}-{variant}-{seed}"
                for variant in load_ablation(name).only(only)
                for scene in options.scenes
                for seed in options.seeds
            }
            missing = sorted(wanted - there)
            trained = missing[: int(max(0.0, options.within - (self.now - begun)) // SECONDS["ablate"] + 1)]
            (folder / "cells").write_text("\n".join({*there, *trained}))
            self.now += len(trained) * SECONDS["ablate"]
            self.begun += [f"{name} {len(trained)}"] if trained else []
            if trained != missing:
                return UNFINISHED
            known = ROOT / f"docs/results/{name}/results.json"
            if known.is_file():
                shutil.copy(known, folder)
            else:  # a study that is not measured yet
                (folder / "results.json").write_text("{}")
        return 0


@pytest.fixture
def machine(turbogs, monkeypatch, tmp_path) -> Machine:
    return Machine(turbogs, monkeypatch, tiny_capture(tmp_path / "demo"))


@pytest.fixture
def call(tmp_path, monkeypatch, capsys):
    """`make results`: exit code and the last line of standard error; of a repository that has docs/ without results."""
    monkeypatch.setattr(measure_readme, "ROOT", tmp_path)
    monkeypatch.setenv(COMMIT_VARIABLE, "0123456")
    scenes = [tmp_path / "scenes" / name for name in ("snowmiku", "fox", "caliterra")]
    tiny = tiny_capture(tmp_path)
    for scene in scenes:
        shutil.copytree(tiny, scene)
        for photo in ("0001.jpg", "IMG_9354.jpg"):
            Image.new("RGB", (32, 24), "green").save(scene / "images" / photo)
    for names in measure_readme.STAGES.values():
        for name in [name for sweep in names for name in getattr(sweep, "names", ())]:
            (tmp_path / "docs/results" / name).mkdir(parents=True, exist_ok=True)
    (tmp_path / "docs/results/h200").mkdir()

    def call(*options: str) -> tuple[int, str]:
        code = measure_readme.main([str(tmp_path / "out"), *map(str, scenes), *options])
        return code, "".join(capsys.readouterr().err.splitlines()[-1:])

    return call


def files_below(folder: Path) -> set[str]:
    return {str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file()}


@pytest.mark.usefixtures("plotted")
def test_parts_of_nine_minutes_make_all_and_none_of_it_twice(machine, call, tmp_path):
    codes, ends = [], []
    while not codes or codes[-1]:
        begun = machine.now
        code, line = call()
        codes.append(code)
        ends.append(machine.now - begun)
        assert line == ("the time is over and not all is done: call it again" if code else "")
        assert not code or files_below(tmp_path / "docs") == set(), "the sources stay those of the commit"
    assert set(codes[:-1]) == {UNFINISHED} and len(codes) > 5
    assert max(ends) <= 540 and min(ends[:-1]) > 540 - 210 - SECONDS["ablate"]
    first = machine.begun.index("sizes 20")
    assert machine.begun[first : first + 20] == [
        *("sizes 20", "sizes 15", "sizes 15", *WALLS, "train", "make_pictures.py", "train", "demo_picture.py"),
        *["pixels_on_an_mlp.py"] * 3,
    ]
    cells = {}
    for name, count in (line.split() for line in machine.begun if line[-1].isdigit()):
        cells[name] = cells.get(name, 0) + int(count)
    assert list(cells) == [
        *("sizes", "paper", "paper_parts", "baselines", "parts", "departures", "density_departures", "bounds"),
        *("cameras", "components", "views", "hard_ratio", "schedule"),
    ]
    assert cells["sizes"] == 6 * 3 * 5 and cells["baselines"] == 4 * 3 and cells["components"] == 6 * 2
    assert cells["paper"] == 2 * 5 * 3 and cells["paper_parts"] == 8 * 5 * 3
    docs = tmp_path / "docs"
    assert (docs / "results/sizes/results.json").read_bytes() == (ROOT / "docs/results/sizes/results.json").read_bytes()
    walls = json.loads((docs / "results/h200/wall.json").read_text())
    assert walls.keys() == {"turbogs", "ssim", "cap-67k", "cap-94k", "cap-157k", "cap-57k"}
    assert list(walls["turbogs"]) == ["fox", "caliterra", "snowmiku"] and list(walls["cap-57k"]) == ["snowmiku"]
    assert walls["turbogs"]["fox"]["of"].endswith("/fox")
    photos = json.loads((docs / "results/pixels_on_an_mlp.json").read_text())
    assert list(photos) == ["synthetic", "fox/images/0001.jpg", "caliterra/images/IMG_9354.jpg"]
    assert json.loads((docs / "results/pictures.json").read_text())["scene"] == "caliterra"
    # A further call finds all there; another commit has nothing.
    done = len(machine.begun)
    assert call()[0] == 0 and len(machine.begun) == done


@pytest.mark.parametrize(("gpus", "told"), [(1, []), (2, ["--gpus", "0,1"])])
def test_the_gpus_of_a_machine_share_the_trainings(monkeypatch, tmp_path, gpus, told):
    called: list[list[str]] = []
    monkeypatch.setattr(measure_readme, "run", lambda words: called.append(words) or 0)
    monkeypatch.setattr(measure_readme.torch.cuda, "device_count", lambda: gpus)
    scenes = {name: tmp_path / name for name in measure_readme.CAPTURES}
    assert measure_readme.Sweep(60, ["parts"]).measure(scenes, tmp_path, 500.0) == 0
    assert called[0][-6:-4] == told if told else "--gpus" not in called[0]


def test_a_stage_alone_and_another_commit(machine, call, tmp_path, monkeypatch):
    assert call("wall", "--within", "8m")[0] == 0
    assert machine.begun == WALLS and machine.now == 400
    assert files_below(tmp_path / "docs") == {"results/h200/wall.json"}
    monkeypatch.setenv(COMMIT_VARIABLE, "89abcde")
    code, line = call("wall", "--within", "6m")  # eight take 320 s; the ninth could take 60
    assert (code, machine.begun[10:]) == (UNFINISHED, WALLS[:8]) and "call it again" in line
    assert call("wall", "--within", "3m")[0] == 0 and machine.begun[18:] == WALLS[8:]
    assert {path.name for path in (tmp_path / "out").iterdir()} == {"0123456", "89abcde"}


def test_the_tables_have_their_time(machine, call, tmp_path):
    """Work may end where too little is left for `make pages`."""
    assert call("wall", "--within", "455s")[0] == UNFINISHED and len(machine.begun) == 10
    assert files_below(tmp_path / "docs") == set()
    assert call("wall", "--within", "455s")[0] == 0 and len(machine.begun) == 10


def test_what_fails_is_tried_again_and_stops_no_other_stage(machine, call, tmp_path):
    machine.broken = "train"
    assert call("pictures", "wall") == (1, "failed: pictures; the same call tries it again")
    assert len(machine.begun) == 10 and files_below(tmp_path / "docs") == set()
    left = tmp_path / "out/0123456/part-pictures"
    left.mkdir()  # as a call that was killed leaves it
    (left / "render.jpg").write_bytes(b"half a picture")
    machine.broken = "nothing"
    machine.monkeypatch.setattr(make_pictures, "main", lambda: pictures(Path(sys.argv[3])))
    assert call("pictures", "wall")[0] == 0 and machine.begun[10:] == ["train", "make_pictures.py"]
    assert (tmp_path / "docs/render.jpg").read_bytes() == b"render.jpg"
    assert not left.exists()


def pictures(folder: Path) -> None:
    folder.mkdir()  # new
    for name in ("render.jpg", "overlays.jpg", "pictures.json"):
        (folder / name).write_text(name)


@pytest.mark.parametrize(
    ("options", "commit", "told"),
    [
        (["walls"], "0123456", "no stage walls: sizes, wall, "),
        (["--within", "2m"], "0123456", "--within: at least 270s"),
        ([], "0123456-modified", "commit them, or name theirs by TURBOGS_COMMIT"),
    ],
)
def test_bad_input_is_told_before_anything_is_measured(call, machine, monkeypatch, capsys, options, commit, told):
    monkeypatch.setenv(COMMIT_VARIABLE, commit)
    with pytest.raises(SystemExit, match="2"):
        call(*options)
    assert told in capsys.readouterr().err.splitlines()[-1] and machine.begun == []


def test_other_captures_are_refused(capsys):
    with pytest.raises(SystemExit, match="2"):
        measure_readme.main(["out", "fox", "caliterra", "garden"])
    assert "README is of fox, caliterra, snowmiku" in capsys.readouterr().err


def placed(folder: Path) -> set[str]:
    """What `make results` puts into docs/, of work whose files are all empty objects."""
    for stage, works in measure_readme.STAGES.items():
        for work in works:
            files = [f"studies/{name}/results.json" for name in getattr(work, "names", ())] or [work.made]
            if stage == "pictures":
                files = [f"pictures/{name}" for name in ("render.jpg", "overlays.jpg", "pictures.json")]
            if stage == "pixels":
                files = [f"{work.made}/{name}" for name in ("psnr.json", "figure.png")]
            for file in files:
                (folder / file).parent.mkdir(parents=True, exist_ok=True)
                (folder / file).write_text("{}")
    return {f"docs/{name}" for stage in measure_readme.STAGES for name in measure_readme.files_of(stage, folder)}


SHOWN = [ROOT / name for name in ("README.md", "docs/comparison.md", "docs/drop-in.md")]
"""Pages that have what `make results` measures; of the last, the network without Gaussians."""


def test_every_table_of_readme_is_made_of_what_is_measured(tmp_path, monkeypatch):
    """But for what is the others' own: a table that reads another file has to come from a stage."""
    reads, read_text = set(), Path.read_text

    def reading(path: Path, *options: object, **named: object) -> str:
        if path.is_relative_to(ROOT / "docs"):
            reads.add(str(path.relative_to(ROOT)))
        return read_text(path, *options, **named)

    blocks = [make_pages.BLOCK.findall(page.read_text(encoding="utf-8")) for page in SHOWN]
    names = [name for of_page in blocks for _, name, _ in of_page if of_page is not blocks[-1] or "mlp" in name]
    assert len(names) > 6 and "pixels_on_an_mlp" in names
    monkeypatch.setattr(Path, "read_text", reading)
    study_tables.read_study.cache_clear()
    tables = {name: make_pages.TABLES[name]() for name in names}
    assert [name for name, made in tables.items() if made is None or "not measured yet" in made.lower()] == []
    assert {"docs/results/h200/wall.json", "docs/results/sizes/results.json"} <= reads
    assert reads - OTHERS <= placed(tmp_path)


def test_every_picture_of_readme_is_made_of_what_is_measured(tmp_path):
    shown = [(page, re.findall(r"!\[[^]]*\]\(([^)]+)\)", page.read_text(encoding="utf-8"))) for page in SHOWN]
    pictures = {str((page.parent / name).relative_to(ROOT)) for page, names in shown for name in names}
    of_tables = str(make_pages.PICTURE.relative_to(ROOT))  # `make pages` draws it
    assert len(pictures) > 4 and of_tables in pictures
    assert pictures - OTHERS - {of_tables} <= placed(tmp_path)


def test_what_is_not_measured_is_named():
    page = (ROOT / "docs/results/README.md").read_text(encoding="utf-8")
    assert [name for name in OTHERS if Path(name).name not in page] == []


def test_every_stage_is_described():
    for name in measure_readme.STAGES:
        assert f"\n    {name}  " in measure_readme.__doc__
        assert f"| `{name}` |" in (ROOT / "docs/results/README.md").read_text(encoding="utf-8")


@pytest.mark.skipif(shutil.which("make") is None, reason="make is not installed")
def test_make_calls_it():
    command = ["make", "--dry-run", "results", "SCENES=a/fox b/caliterra c/snowmiku", "STAGES=wall", "WITHIN=5m"]
    printed = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout
    called = "docs/measure_readme.py results a/fox b/caliterra c/snowmiku wall --within 5m\n"
    assert called in printed and printed.index(called) < printed.index("docs/make_pages.py")
