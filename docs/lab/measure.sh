#!/usr/bin/env bash
# Measures what README and docs/lab show of TurboGS, on a machine with a GPU; `make results` calls it:
#
#     docs/lab/measure.sh OUT FOX CALITERRA SNOWMIKU
#
# The captures are folders of these names. Results lie in OUT/COMMIT; what is there is not measured again, so the same
# call goes on after a stop (Ctrl-C, or `timeout --signal INT 9m`). When all is there, it is copied into docs/lab.
set -euo pipefail
cd "$(dirname "$0")/../.."
if [ -z "${TURBOGS_COMMIT:-}" ] && [ -n "$(git status --porcelain --untracked-files=no)" ]; then
    echo "the sources have changes that are in no commit: commit them first" >&2
    exit 2
fi
out=$1/${TURBOGS_COMMIT:-$(git rev-parse --short HEAD)}
shift
scenes=()
for capture in "$@"; do scenes+=(--scene "$capture"); done
gpus=$(nvidia-smi --list-gpus | wc -l)
mkdir -p "$out"

ablate() { # NAME SEED ...
    turbogs ablate "$1" "${scenes[@]}" --gpus "$gpus" --out "$out/$1" --seeds "${@:2}"
}

wall() { # VARIANT CAPTURE REPEATS SETTING ...
    local file=$out/wall-$1-$(basename "$2").json
    [ -e "$file" ] || turbogs bench wall "${@:4}" --scene "$2" --repeats "$3" --out "$file"
}

studies="sizes paper parts departures density_departures bounds cameras paper_parts"
for study in $studies; do ablate "$study" 0 1 2 3 4; done
ablate baselines 0
structure=(density.absgrad_threshold=4.5e-4 pixel_sampler.unit=tile loss.type=sparse_ssim loss.ssim_weight=0.4)
for capture in "$@"; do
    wall turbogs "$capture" 3
    wall ssim "$capture" 1 "${structure[@]}" train.dropout=auto # configs/turbogs-ssim.yaml
done
wall cap-67k "$1" 1 density.max_gaussians=67000
wall cap-94k "$1" 1 density.max_gaussians=94000
wall cap-157k "$2" 1 density.max_gaussians=157000
wall cap-57k "$3" 1 density.max_gaussians=57000

for study in $studies baselines; do cp "$out/$study/results.json" "docs/lab/$study/"; done
python - "$out" <<'PYTHON'
"""Joins the walls: variant -> capture -> what `turbogs bench wall` wrote."""
import json, pathlib, sys

walls = {}
for file in sorted(pathlib.Path(sys.argv[1]).glob("wall-*.json")):
    variant, capture = file.stem.removeprefix("wall-").rsplit("-", 1)
    walls.setdefault(variant, {})[capture] = json.loads(file.read_text())
pathlib.Path("docs/lab/wall.json").write_text(json.dumps(walls, indent=1) + "\n")
PYTHON
